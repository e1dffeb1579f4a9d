"""What everything else rests on, in plain Python: records, errors, files that appear whole, signals."""
