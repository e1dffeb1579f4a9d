"""Geometry: space, shapes, targets, polylines, floor fields, and the neighbour search."""
