"""Theory that explains runs, and that no engine uses: folds and strata, switching laws, the blow-up, slow time."""
