"""What explains: folds and strata, other friction laws, the blow-up, slow time."""
