"""Space and its contents: shapes, targets, polylines, travel distances; and the neighbour search."""
