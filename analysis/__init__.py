"""From event series to statements: cascades, estimates with uncertainty, figures, the report.

Takes arrays and data frames; knows no files but those the report writes. All quantities are dimensionless.
"""

from analysis.cascades import DEFINITIONS, Law, Window, laws, sample, sizes, window
from analysis.chance.nulls import random_order
from analysis.fits import Estimate, correlation_time, gamma, over_matrices
from analysis.report import Report, build
from analysis.section import Data, Section
from analysis.settings import AnalysisSettings

__all__ = [
    "DEFINITIONS",
    "AnalysisSettings",
    "Data",
    "Estimate",
    "Law",
    "Report",
    "Section",
    "Window",
    "build",
    "correlation_time",
    "gamma",
    "laws",
    "over_matrices",
    "random_order",
    "sample",
    "sizes",
    "window",
]
