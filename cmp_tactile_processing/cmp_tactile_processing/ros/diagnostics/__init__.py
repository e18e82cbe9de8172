"""Figures of a node on /diagnostics.

In: what a node counts and measures.
Out: one status for each node, with a level, a sentence and figures.
"""
