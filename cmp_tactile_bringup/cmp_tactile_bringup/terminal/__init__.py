"""What a command prints and waits for.

In: results, progress, signals.
Out: tables, progress lines, error lines.
"""
