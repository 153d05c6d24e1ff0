"""The report: what stands on its page, the layout, the files beside it, and the comparison of two datasets."""

PAGE = "report.html"  # name of the page among the files of a report
FINDINGS = "report/findings.json"
OF_OWN = '<meta name="own-questions" content="run">'  # at the head of a page for which a user's own were run

#: The beginning of a text that a spreadsheet would take for a formula, and what stands for it in CSV.
FORMULA, AS_TEXT = r"^([=+\-@\t\r])", r"'\1"
