"""Figures of a node on /diagnostics.

In: what a node counts and measures.
Out: levels that do not flicker, and their texts.
"""
