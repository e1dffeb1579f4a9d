"""Measurements, side by side: `python -m benchmarks.NAME`. Timings are reported as ratios, and never asserted."""
