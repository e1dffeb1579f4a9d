"""Players that do nothing sensible: a benchmark that they pass measures nothing."""
