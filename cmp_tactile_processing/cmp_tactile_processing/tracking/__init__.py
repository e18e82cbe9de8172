"""From the image of a view to the numbered grid.

In: the grey image of a view and the nominal grid.
Out: `Grid`: markers, virtual markers, status.
"""
