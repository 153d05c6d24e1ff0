"""From event series to statements: cascades, estimates with uncertainty, figures, the report.

Takes arrays and data frames; knows no files. All quantities are dimensionless.
"""

import lazy_loader

# A room is loaded when one of its names is first used: drawing alone needs no statistics. The names are in
# __init__.pyi.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
