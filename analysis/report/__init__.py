"""The page: sections, tables, figures, words."""

PAGE = "report.html"  # among the files of a report
