"""A scene expanded: members, and the batches that they are computed in."""
