"""flockenv on the command line."""
