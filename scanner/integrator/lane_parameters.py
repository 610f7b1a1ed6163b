"""Parameters of a law in one lane, indexed by the law as an array would be.

An array of one lane's parameters, cut from a table of all lanes, counts references, and the compiler would not compute
several lanes at once. This type is an address, a number of places and a lane. It has ``p[i]`` and ``len(p)``.
"""

from __future__ import annotations

import operator
from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

from scanner.integrator.abi import LANES

_TABLE = types.CPointer(types.float64)


class _LaneParameters(types.Type):
    def __init__(self) -> None:
        super().__init__(name="LaneParameters")


_LANE_PARAMETERS = _LaneParameters()


@register_model(_LaneParameters)
class _LaneParametersModel(models.StructModel):
    def __init__(self, manager: Any, own_type: Any) -> None:
        super().__init__(manager, own_type, [("table", _TABLE), ("places", types.int64), ("lane", types.int64)])


@intrinsic
def lane_parameters(context, table, places, lane):  # type: ignore[no-untyped-def]
    """Parameters of ``lane`` in a table of shape (``places``, ``LANES``), given as a pointer."""

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        parameters = cgutils.create_struct_proxy(_LANE_PARAMETERS)(context, builder)
        parameters.table, parameters.places, parameters.lane = arguments
        return parameters._getvalue()

    return _LANE_PARAMETERS(_TABLE, types.int64, types.int64), code


@intrinsic
def _value(context, parameters, place):  # type: ignore[no-untyped-def]
    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        own = cgutils.create_struct_proxy(_LANE_PARAMETERS)(context, builder, value=arguments[0])
        row = builder.mul(arguments[1], context.get_constant(types.int64, LANES))
        return builder.load(builder.gep(own.table, [builder.add(row, own.lane)]))

    return types.float64(_LANE_PARAMETERS, types.int64), code


@intrinsic
def _places(context, parameters):  # type: ignore[no-untyped-def]
    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return cgutils.create_struct_proxy(_LANE_PARAMETERS)(context, builder, value=arguments[0]).places

    return types.int64(_LANE_PARAMETERS), code


@overload(len)
def _len(parameters):  # type: ignore[no-untyped-def]
    if isinstance(parameters, _LaneParameters):
        return lambda parameters: _places(parameters)
    return None


@overload(operator.getitem)
def _getitem(parameters, place):  # type: ignore[no-untyped-def]
    if isinstance(parameters, _LaneParameters) and isinstance(place, types.Integer | types.IntegerLiteral):
        return lambda parameters, place: _value(parameters, place if place >= 0 else place + _places(parameters))
    return None
