"""What knows no friction: checks of arguments, arithmetic, roots, products of K with vectors, lanes, coefficients."""
