"""What chance alone gives: null models, the map of gamma, and whether exits cluster beyond them."""
