"""Faces of one World: gymnasium (single.py, vector.py), pettingzoo (parallel.py, aec.py); SB3's is flockenv.sb3.

They hold no physics and no rules: they translate shapes, names and conventions, so that one action sequence through
any of them gives the same numbers.
"""
