"""What explains, and no engine needs: folds and strata, other friction laws, the blow-up, slow time."""
