"""Other libraries that play our environments, each in a virtual environment of its own: `python -m tests.clients`.

They are slow and need the network, so no test run collects them: a script `play_NAME.py` per client, with the packages
that it needs in its head (PEP 723).
"""
