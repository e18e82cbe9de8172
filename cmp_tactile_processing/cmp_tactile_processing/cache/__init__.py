"""Files that programs of this suite keep or share.

In: what is expensive to compute or to compile.
Out: caches on disk, atomic writes, locks, the threads of BLAS.
"""
