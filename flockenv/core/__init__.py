"""The foundations, in plain Python: records, error messages, atomic files, signals."""
