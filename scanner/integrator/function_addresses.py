"""Addresses of compiled functions: the only place that uses a private name of numba.

numba's first-class functions look up the address of a compiled function at every call through the dispatcher, which
takes longer than a short integration. ``FunctionAddress`` looks it up once and then returns the stored address. numba
has the protocol for that (``types.WrapperAddressProtocol``) in its public interface, but not the function that computes
the address, ``numba.experimental.function_type._get_wrapper_address``. If a release of numba moves or renames it,
``tests/scanner/test_integrator.py`` fails and says what to do.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import NumbaExperimentalFeatureWarning, types
from numba.experimental.function_type import _get_wrapper_address

# numba calls first-class functions experimental. All signatures are fixed in this package, so the warning that their
# types may be inferred differently in another release does not apply.
warnings.filterwarnings("ignore", category=NumbaExperimentalFeatureWarning)


class FunctionAddress(types.WrapperAddressProtocol):
    """The address of a compiled function with one signature, as an argument for compiled code."""

    def __init__(self, function: Callable[..., Any]):
        self._signature = function.nopython_signatures[0]  # type: ignore[attr-defined]
        self._address = _get_wrapper_address(function, self._signature)

    def __wrapper_address__(self) -> int:
        return self._address

    def signature(self) -> Any:
        return self._signature


address_of = cache(FunctionAddress)
"""The address of a compiled function, computed once per function."""
