"""What blocks do together: estimates over the systems of an ensemble, each with its interval."""
