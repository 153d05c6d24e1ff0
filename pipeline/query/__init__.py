"""Reading a dataset: members, series, events and episodes as frames and arrays, and SQL."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
