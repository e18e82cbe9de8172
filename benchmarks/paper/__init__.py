"""The experiments of the paper (sections IV and V) with this software, compared with its figures.

`make paper` runs them; see __main__.py.
"""
