"""Sixteen numbers side by side: what a processor computes at once, as a type that compiled loops hold in variables.

LLVM finds such rows by itself in simple loops only, and not in sums, whose order it must not change. Here they are written
down: sixteen pixels are one value, every sum has its order, and a product is rounded unless :func:`fused` is asked for. So
what comes out of them does not depend on how many numbers a processor has room for.

    alphas = decay(exponents) * opacity
    weights = choose(alphas >= MIN_ALPHA, alphas * through, 0.0)

Operators and functions take lanes, or a number that stands in all of them.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from math import factorial
from typing import Any, cast

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.extending import intrinsic, overload, register_model
from numba.np import arrayobj

WIDTH = 16
"""Lanes: in float32 one register of AVX-512, two of AVX, four of SSE or NEON. More registers than one are worth having
too, since what has to wait is done beside the other half."""

_WORD = ir.IntType(32)


class Lanes(types.Type):
    """Numba's type of sixteen numbers, or of sixteen truths, whose number is ``boolean``."""

    def __init__(self, number: types.Type) -> None:
        self.number = number
        super().__init__(name=f"Lanes({number})")


@register_model(Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Lanes) -> None:
        one = ir.IntType(1) if kind.number == types.boolean else manager.lookup(kind.number).get_value_type()
        super().__init__(manager, kind, ir.VectorType(one, WIDTH))


TRUTHS = Lanes(types.boolean)


def _intrinsic(function: Callable[..., Any]) -> Callable[..., Any]:
    return cast(Callable[..., Any], intrinsic(function))


def _spread(context: Any, builder: Any, value: Any, kind: Any, lanes: Lanes) -> Any:
    """A number in all lanes; lanes as they are."""
    if isinstance(kind, Lanes):
        return value
    number = context.cast(builder, value, kind, lanes.number)
    nothing = ir.Constant(ir.VectorType(number.type, WIDTH), ir.Undefined)
    first = builder.insert_element(nothing, number, ir.Constant(_WORD, 0))
    return _shuffled(builder, first, nothing, [0] * WIDTH)


def _shuffled(builder: Any, a: Any, b: Any, places: Sequence[int]) -> Any:
    """Lanes of ``a``, numbered from 0, and of ``b``, numbered from 16."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_WORD, len(places)), list(places)))


def _lane_by_lane(operands: Sequence[Any], write: Callable[..., Any], result: Lanes | None = None) -> Any:
    """What an intrinsic returns: signature, and code that ``write(builder, *lanes)`` adds. None without lanes of numbers."""
    lanes = next((kind for kind in operands if isinstance(kind, Lanes) and kind != TRUTHS), None)
    if lanes is None:
        return None

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        spread = [
            value if kind == TRUTHS else _spread(context, builder, value, kind, lanes)
            for value, kind in zip(arguments, operands)
        ]
        return write(builder, *spread)

    return (result or lanes)(*operands), generate


def _operator(function: Callable[..., Any], write: Callable[..., Any], result: Lanes | None = None) -> None:
    """Let an operator take lanes on one side or on both."""

    @_intrinsic
    def action(typing: Any, a: Any, b: Any) -> Any:
        return _lane_by_lane((a, b), write, result)

    @overload(function)
    def chosen(a: Any, b: Any) -> Any:
        def of_lanes(a: Any, b: Any) -> Any:
            return action(a, b)

        return of_lanes if isinstance(a, Lanes) or isinstance(b, Lanes) else None


def _comparison(sign: str) -> Callable[..., Any]:
    def write(builder: Any, a: Any, b: Any) -> Any:
        if isinstance(a.type.element, ir.IntType):
            return builder.icmp_signed(sign, a, b)
        return builder.fcmp_ordered(sign, a, b)

    return write


_operator(operator.add, lambda builder, a, b: builder.fadd(a, b))
_operator(operator.sub, lambda builder, a, b: builder.fsub(a, b))
_operator(operator.mul, lambda builder, a, b: builder.fmul(a, b))
_operator(operator.truediv, lambda builder, a, b: builder.fdiv(a, b))
_operator(operator.lt, _comparison("<"), TRUTHS)
_operator(operator.le, _comparison("<="), TRUTHS)
_operator(operator.gt, _comparison(">"), TRUTHS)
_operator(operator.ge, _comparison(">="), TRUTHS)


@_intrinsic
def both(typing: Any, a: Any, b: Any) -> Any:
    """Where ``a`` and ``b`` are true."""
    return TRUTHS(a, b), lambda context, builder, signature, arguments: builder.and_(*arguments)


@_intrinsic
def anywhere(typing: Any, truths: Any) -> Any:
    """Whether any lane is true."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bits = builder.bitcast(arguments[0], ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(truths), generate


@_intrinsic
def choose(typing: Any, truths: Any, a: Any, b: Any) -> Any:
    """``a`` where it is true, else ``b``; one of the two may be a number."""
    return _lane_by_lane((truths, a, b), lambda builder, *three: builder.select(*three))


@_intrinsic
def least(typing: Any, a: Any, b: Any) -> Any:
    """The smaller of the two; ``b`` where one is no number."""
    return _lane_by_lane((a, b), lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))


@_intrinsic
def magnitude(typing: Any, a: Any) -> Any:
    """The absolute value."""
    return _lane_by_lane((a,), lambda builder, a: _call(builder, "fabs", a))


@_intrinsic
def fused(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c, rounded once."""
    return _lane_by_lane((a, b, c), lambda builder, *three: _call(builder, "fma", *three))


def _call(builder: Any, name: str, *lanes: Any) -> Any:
    """One of LLVM's functions of lanes."""
    kind = lanes[0].type
    suffix = f"v{WIDTH}f{32 if isinstance(kind.element, ir.FloatType) else 64}"
    signature = ir.FunctionType(kind, [kind] * len(lanes))
    return builder.call(cgutils.get_or_insert_function(builder.module, signature, f"llvm.{name}.{suffix}"), lanes)


def _address(context: Any, builder: Any, kind: Any, array: Any, place: Any) -> Any:
    """Where a lane's number of a C-contiguous array lies, as the address of lanes."""
    data = arrayobj.make_array(kind)(context, builder, array).data
    lanes = ir.VectorType(context.get_data_type(kind.dtype), WIDTH)
    return builder.bitcast(builder.gep(data, [place]), lanes.as_pointer())


@_intrinsic
def load(typing: Any, array: Any, place: Any) -> Any:
    """Sixteen numbers of a C-contiguous array, from ``place`` on in the order of memory. Bounds are not checked."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_address(context, builder, array, *arguments), align=array.dtype.bitwidth // 8)

    return Lanes(array.dtype)(array, types.intp), generate


@_intrinsic
def spread(typing: Any, array: Any, place: Any) -> Any:
    """One number of a C-contiguous array, at ``place`` in the order of memory, in all lanes."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = arrayobj.make_array(array)(context, builder, arguments[0]).data
        number = builder.load(builder.gep(data, [arguments[1]]))
        return _spread(context, builder, number, array.dtype, signature.return_type)

    return Lanes(array.dtype)(array, types.intp), generate


@_intrinsic
def store(typing: Any, array: Any, place: Any, values: Any) -> Any:
    """Write what :func:`load` reads; a number is written sixteen times."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes = _spread(context, builder, arguments[2], values, Lanes(array.dtype))
        address = _address(context, builder, array, *arguments[:2])
        builder.store(lanes, address, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, values), generate


@_intrinsic
def zeros(typing: Any, array: Any) -> Any:
    """Lanes of zeros, of the kind of an array's numbers."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return ir.Constant(context.get_value_type(signature.return_type), None)

    return Lanes(array.dtype)(array), generate


@_intrinsic
def store_totals(
    typing: Any, array: Any, place: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any
) -> Any:
    """Write the sums of eight lanes side by side: of each its halves are added, then neighbours, pairs and quadruples."""
    rows = (a, b, c, d, e, f, g, h)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        sums = [
            builder.fadd(_shuffled(builder, row, row, range(8)), _shuffled(builder, row, row, range(8, 16)))
            for row in arguments[2:]
        ]
        for size in (1, 2, 4):
            # Blocks of `size` numbers of one row stand beside those of the next.
            first = [row * 8 + block + i for block in range(0, 8, 2 * size) for row in (0, 1) for i in range(size)]
            second = [place + size for place in first]
            sums = [
                builder.fadd(_shuffled(builder, a, b, first), _shuffled(builder, a, b, second))
                for a, b in zip(sums[::2], sums[1::2])
            ]
        data = _address(context, builder, array, *arguments[:2])
        builder.store(sums[0], builder.bitcast(data, sums[0].type.as_pointer()), align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, *rows), generate


@_intrinsic
def decay(typing: Any, x: Any) -> Any:
    """exp(-x) of lanes between 0 and 80, within one and a half units in the last place.

    2^n exp(-r) with n the integer next to -x / log(2), and Taylor's series for -r, which is at most log(2) / 2.
    """

    def write(builder: Any, x: Any) -> Any:
        single = isinstance(x.type.element, ir.FloatType)
        mantissa, terms = (23, 8) if single else (52, 14)
        # log(2) in two parts, of which the first has so few bits that its product with n is exact.
        high, low = (0.693359375, -2.12194440e-4) if single else (0.693147180369123816490, 1.90821492927058770002e-10)

        def constant(value: float) -> Any:
            return ir.Constant(x.type, [value] * WIDTH)

        # Added to a number this large, -x / log(2) is rounded to an integer, which stands in the lowest bits.
        large = constant(1.5 * 2.0**mantissa)
        shifted = _call(builder, "fma", x, constant(-1.4426950408889634), large)
        n = builder.fsub(shifted, large)
        r = _call(builder, "fma", n, constant(high), x)
        r = _call(builder, "fma", n, constant(low), r)
        square = builder.fmul(r, r)
        even, odd = (constant((-1) ** k / factorial(k)) for k in (terms - 2, terms - 1))
        for k in range(terms - 4, -1, -2):
            even = _call(builder, "fma", even, square, constant((-1) ** k / factorial(k)))
            odd = _call(builder, "fma", odd, square, constant((-1) ** (k + 1) / factorial(k + 1)))
        value = _call(builder, "fma", odd, r, even)
        bits = ir.VectorType(ir.IntType(32 if single else 64), WIDTH)
        power = builder.shl(builder.bitcast(shifted, bits), ir.Constant(bits, [mantissa] * WIDTH))
        return builder.bitcast(builder.add(builder.bitcast(value, bits), power), x.type)

    return _lane_by_lane((x,), write)
