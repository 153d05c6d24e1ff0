"""Answers and reports as tests look at them."""


def of_kind(answer, kind):
    """Its findings of one kind."""
    return [finding for finding in answer.findings if isinstance(finding, kind)]


def contents(report):
    """The bytes of its files, by path."""
    return {name: make() for name, make in report.files().items()}
