"""From event series to statements: cascades, estimates with uncertainty, figures, the report.

Takes arrays and data frames; knows no files but those the report writes. All quantities are dimensionless.
"""

from analysis.cascades import DEFINITIONS, Law, Window, laws, sample, sizes, window
from analysis.fits import Estimate, correlation_time, gamma, over_matrices, random_order
from analysis.report import Report, build
from analysis.settings import AnalysisSettings

__all__ = [
    "DEFINITIONS",
    "AnalysisSettings",
    "Estimate",
    "Law",
    "Report",
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
