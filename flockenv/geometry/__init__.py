"""Space and what stands in it: shapes, targets, polylines, travel times; and how neighbours are found."""
