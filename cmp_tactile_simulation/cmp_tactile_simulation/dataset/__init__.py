"""Datasets for learning: many presses with their truth, drawn from a recipe.

In: a recipe's file.
Out: shards of samples (netCDF), each the same whenever and wherever it is made.
"""
