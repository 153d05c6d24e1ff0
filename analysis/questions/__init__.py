"""The questions that a report can answer: one file each, and one template of the same name in `report/templates`.

The order is that of the page.
"""

QUESTIONS = (
    "sweep", "episodes", "cascades", "counting", "exponential", "definitions", "rhythm", "clustering", "fates",
    "engines", "sensitivity", "robustness",
)  # fmt: skip
#: Those that are not asked where episodes are recorded, which hold the cascades.
OF_CASCADES = ("cascades", "counting", "exponential", "definitions", "rhythm", "clustering")
