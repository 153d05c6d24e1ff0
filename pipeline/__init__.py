"""From a scene file to a dataset and back: which runs, where they run, how they are kept and found.

Reading is in `pipeline.query`: ``query.members(path)``, ``query.n_stick(path, member_id)``, ``query.sql(...)``.
"""

import lazy_loader

# Each room is loaded when a name of it is first asked for: scenes need neither dask nor pandas, which take a second.
# The names are in __init__.pyi.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
