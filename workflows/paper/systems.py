"""What a scene of the chart `paper` asks for, and the systems that it draws: those of an ensemble with its seed."""

from __future__ import annotations

from typing import Annotated, Literal, get_args

from pydantic import Field, model_validator

from stickslip import sim
from stickslip.pipeline.design import PERTURBATION
from stickslip.pipeline.scene import TOLERANCES
from stickslip.pipeline.toml import BlockNumbers, Blocks, Count, Positive, PositiveNumbers
from stickslip.sim.engines.contract import Purpose
from stickslip.workflows.charts import ChartScene, Several
from stickslip.workflows.charts.peers import W0, Z0, Floats, random_system, seed_of

Law = Literal["coulomb", "sigmoid"]
LAWS: tuple[Law, ...] = get_args(Law)


class PaperSystems(ChartScene):
    """The keys of a scene with ``chart = "paper"``; dimensionless."""

    chart: Literal["paper"] = Field(description="kind of the chart", examples=["paper"])
    title: str = Field(default="The paper's figures", description="one line for the report's head")
    figures: Several[Annotated[int, Field(ge=1, le=6)]] = Field(
        min_length=1, description="numbers of the figures", examples=[[3, 5]]
    )
    n: BlockNumbers = Field(default=(20, 100, 200), description="numbers of blocks of figure 3", examples=[[20, 100]])
    draws: Count = Field(default=10, description="number of matrices for each n of figure 3", examples=[10])
    t_end: Positive = Field(default=1000.0, description="end of the runs of figures 3 and 4", examples=[1000.0])
    t_shown: Positive = Field(default=200.0, description="time to which they are drawn", examples=[200.0])
    eps: Annotated[float, Field(gt=0, lt=1)] = Field(
        default=0.03, description="width of the sigmoid", examples=[0.03]
    )
    sensitivity_n: BlockNumbers = Field(
        default=(20, 200), description="numbers of blocks of figure 4", examples=[[20, 200]]
    )
    sets: Count = Field(default=3, description="number of random draws in a panel of figures 4 and 5", examples=[3])
    sizes: PositiveNumbers = Field(
        default=(0.01, 0.02, 0.05, 0.1), description="sizes of the perturbations of figure 4", examples=[[0.01, 0.1]]
    )
    long_n: Blocks = Field(default=200, description="number of blocks of figure 5", examples=[200])
    long_matrices: Count = Field(default=10, description="number of matrices of figure 5", examples=[10])
    long_t_end: Positive = Field(default=1000.0, description="end of the runs of figure 5", examples=[1000.0])
    t_burn: Positive = Field(default=600.0, description="time before which no cascade is counted", examples=[600.0])
    dt: PositiveNumbers = Field(default=(0.1, 0.3, 1.0), description="sampling steps of cascades", examples=[[0.1]])
    claims: bool = Field(
        default=False, description="whether the text's other claims are counted too, about a minute", examples=[True]
    )
    survival_n: BlockNumbers = Field(
        default=(20, 50, 80, 100, 120, 150, 200, 250, 300), description="numbers of blocks of the survival curve",
        examples=[[20, 100, 200]],
    )  # fmt: skip
    survival_matrices: Count = Field(default=20, description="number of matrices for each of them", examples=[20])
    survival_t_end: Positive = Field(default=2000.0, description="end of their runs", examples=[2000.0])
    certificate_n: BlockNumbers = Field(
        default=(20, 50, 100), description="numbers of blocks for which the certificate is tried",
        examples=[[20, 50]],
    )  # fmt: skip
    certificate_draws: Count = Field(default=100, description="number of matrices for each of them", examples=[100])
    certificate_t_end: Positive = Field(
        default=2000.0, description="time to which certified runs are continued", examples=[2000.0]
    )
    blocks: Count = Field(default=300, description="number of random single blocks", examples=[300])
    workers: Count = Field(default=2, description="number of local workers", examples=[2])

    @model_validator(mode="after")
    def _in_order(self) -> PaperSystems:
        for early, late in (("t_shown", "t_end"), ("t_burn", "long_t_end")):
            if getattr(self, early) > getattr(self, late) or (early == "t_burn" and self.t_burn == self.long_t_end):
                raise ValueError(
                    f"{early}: expected less than {late} = {getattr(self, late):g}, got {getattr(self, early):g};"
                    f" shorten the one or lengthen the other"
                )
        return self

    def system(self, n: int, matrix: int) -> sim.System:
        return random_system(self.seed, n, matrix)

    def perturbed(self, n: int, size: float, draw: int) -> sim.System:
        """Matrix 0 with every constant moved; one draw goes the same way at every size."""
        return sim.perturb_system(
            self.system(n, 0), "antisymmetric", size, seed_of(self.seed, PERTURBATION, n, 0, draw)
        )

    def run(
        self, system: sim.System, t_end: float, law: Law, purpose: Purpose = "paths", ratio: Floats | float = 1.0
    ) -> sim.Run:
        """From the paper's start, by the tolerances that a scene of that purpose gets."""
        picked = TOLERANCES[purpose]
        if law == "coulomb":
            return sim.simulate(system, Z0, W0, t_end, tol=picked["tol"])
        return sim.simulate(
            system, Z0, W0, t_end, engine="sigmoid", eps=self.eps, ratio=ratio, rtol=picked["rtol"],
            atol=picked["atol"],
        )  # fmt: skip
