"""What is kept of a run: a file and a line here make a record known to scenes, workers, datasets and the guide."""

from stickslip.pipeline.records.attractor import AttractorRecord
from stickslip.pipeline.records.collapse import CollapseRecord
from stickslip.pipeline.records.constants import Constants
from stickslip.pipeline.records.contacts import Contacts
from stickslip.pipeline.records.motion.amplitude import Amplitude
from stickslip.pipeline.records.motion.critical_mode import CriticalModeRecord
from stickslip.pipeline.records.motion.end import End
from stickslip.pipeline.records.motion.energy import EnergyRecord, EpisodeEnergy
from stickslip.pipeline.records.motion.friction_power import FrictionPower
from stickslip.pipeline.records.motion.growth_rate import GrowthRate
from stickslip.pipeline.records.motion.separation import Separation
from stickslip.pipeline.records.motion.slip_speed import SlipSpeed
from stickslip.pipeline.records.outcome import OutcomeRecord
from stickslip.pipeline.records.own import OwnRecord
from stickslip.pipeline.records.record import Record
from stickslip.pipeline.records.refine import Refine
from stickslip.pipeline.records.slips.clusters import ClustersRecord
from stickslip.pipeline.records.slips.episodes import EpisodesRecord
from stickslip.pipeline.records.slips.events import Events
from stickslip.pipeline.records.slips.first_exit import FirstExit
from stickslip.pipeline.records.slips.stick_share import StickShare
from stickslip.pipeline.records.slips.thresholds import Thresholds
from stickslip.pipeline.records.slips.waiting import Waiting
from stickslip.pipeline.records.structure import Structure

__all__ = ["ALWAYS", "RECORDS", "TABLES", "End", "Record"]

#: Of every run.
ALWAYS = OutcomeRecord()

#: What a scene may ask for, in the order of their columns; one that takes from another comes after it.
RECORDS: tuple[type[Record], ...] = (
    End,
    CollapseRecord,
    GrowthRate,
    Events,
    EpisodesRecord,
    EnergyRecord,
    EpisodeEnergy,
    ClustersRecord,
    Separation,
    Thresholds,
    Amplitude,
    SlipSpeed,
    StickShare,
    FirstExit,
    Waiting,
    FrictionPower,
    AttractorRecord,
    CriticalModeRecord,
    Refine,
    Structure,
    Constants,
    Contacts,
    OwnRecord,
)
Contacts.keep_beside(RECORDS)

#: What are tables of their own in SQL and frames, and the lines that ask for them.
TABLES = {record.name: record.asked_by for record in (Events, EpisodesRecord, ClustersRecord, Separation, Thresholds)}
