"""Reports as tests look at them."""


def contents(report):
    """The bytes of its files, by path."""
    return {name: make() for name, make in report.files().items()}
