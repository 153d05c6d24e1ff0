"""Systems of blocks: couplings, forces and belts, friction."""
