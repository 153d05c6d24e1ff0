"""The page: sections, tables, figures, words."""
