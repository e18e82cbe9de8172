"""The paper's experiments (sections IV and V) on this chain, its figures beside ours.

`make paper` runs them; see __main__.py.
"""
