"""The report: the page, its templates, and the comparison of two datasets."""

PAGE = "report.html"  # name of the page among the files of a report
