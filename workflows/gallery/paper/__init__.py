"""The paper's figures and claims, computed again: `stickslip run paper`, `fig1` to `fig6`."""
