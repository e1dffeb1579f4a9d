"""The command line of flockenv."""
