"""What reports say of some fifty small datasets, as text: a change of the analysis shows what it changes.

    python -m tests.statements OUT --datasets DIR        what each report says, and its tables, one folder a dataset
    python -m tests.statements --compare OLD NEW         what differs, numbers by value

The datasets are all ensembles that ship, shrunk, and one for each state that data may be in (`scenes.py`). Those that
DIR lacks are made first, in some minutes; reports are without figures. Make OLD and NEW on one machine, from the same
DIR: a chaotic run takes another path on another CPU. `--only NAME ...` takes some of them, `--new` runs them anew.
"""
