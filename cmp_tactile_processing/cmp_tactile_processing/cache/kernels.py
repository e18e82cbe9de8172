"""How numba compiles our functions: kernels, which Python calls, and the parts of kernels."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np
from numba import njit
from numba.extending import register_jitable
from numpy.typing import NDArray

LOGGER = logging.getLogger(__name__)

# Nobody calls them by address; a division by zero gives what NumPy gives.
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
# What `fastmath` may do where a value may be NaN.
NAN_SAFE = {"arcp", "contract", "reassoc"}
Function = TypeVar("Function", bound=Callable[..., Any])


@overload
def kernel(function: Function) -> Function: ...
@overload
def kernel(**options: Any) -> Callable[[Function], Function]: ...
def kernel(function: Any = None, **options: Any) -> Any:
    """A function that Python calls: compiled at its first call, kept in the cache, without the GIL.

    options: those of `numba.njit`, such as `fastmath`; `nogil=False` for one that takes
    microseconds, after which a busy thread would not give the GIL back for milliseconds.
    """
    decorate = njit(cache=True, **{**OPTIONS, **options})

    def made(function: Any) -> Any:
        return _running_on_a_full_disk(decorate(function))

    return made if function is None else made(function)


def _running_on_a_full_disk(dispatcher: Any) -> Any:
    """The dispatcher; where its cache cannot be written, numba would not run what it compiled."""
    cache = getattr(dispatcher, "_cache", None)
    if cache is None:  # a plain function, by NUMBA_DISABLE_JIT
        return dispatcher
    save = cache.save_overload

    def try_to_save(signature: Any, compiled: Any) -> None:
        try:
            save(signature, compiled)
        except OSError as error:
            folder = Path(cache.cache_path).parent
            _warn_once(f"{folder}: {error.strerror}: compiled functions are not kept")

    cache.save_overload = try_to_save
    return dispatcher


@functools.cache
def _warn_once(text: str) -> None:
    LOGGER.warning(text)


@overload
def kernel_part(function: Function) -> Function: ...
@overload
def kernel_part(**options: Any) -> Callable[[Function], Function]: ...
def kernel_part(function: Any = None, **options: Any) -> Any:
    """A function that kernels call: compiled as a part of them, in half the time of a kernel.

    Called from Python it is not compiled, but runs as any function.  options: as for `kernel`.
    """
    decorate = register_jitable(**OPTIONS, **options)
    return decorate if function is None else decorate(function)


def plain(array: NDArray[Any], dtype: type[Any]) -> NDArray[Any]:
    """The array as kernels take it: they would be compiled again, in a frame, for any other."""
    if array.dtype == dtype and array.flags.carray:
        return array
    return np.require(array, dtype, ["C", "W"])
