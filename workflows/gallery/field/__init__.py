"""Results of the field, reproduced: scenes of one block and of two, each a page of claims with our numbers."""
