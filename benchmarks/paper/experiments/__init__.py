"""The experiments: for each a module that computes, and one that reports."""
