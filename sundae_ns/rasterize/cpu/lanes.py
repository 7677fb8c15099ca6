"""SIMD values for loops compiled by numba: sixteen numbers that a loop holds in one variable, or four of int32.

LLVM vectorises simple loops only, and no sums, whose order it must not change. Here a variable holds sixteen pixels,
every sum has a fixed order, and only :func:`fma` leaves a product unrounded, so results do not depend on the width of
the processor's registers. A plain numba loop takes seven times as long.

Operators and functions take lanes, or a scalar that is broadcast to all of them.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from functools import partial
from math import factorial
from typing import Any, cast

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.extending import intrinsic, overload, register_model
from numba.np import arrayobj

WIDTH = 16  # Lanes of floats: in float32 one register of AVX-512, or four of SSE or NEON, whose latencies overlap

_WORD = ir.IntType(32)


class Lanes(types.Type):
    """Numba's type of sixteen numbers, of four of int32, or of a mask of sixteen booleans."""

    def __init__(self, number: types.Type) -> None:
        self.number, self.width = number, 4 if number == types.int32 else WIDTH
        super().__init__(name=f"Lanes({number})")


@register_model(Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Lanes) -> None:
        element = ir.IntType(1) if kind.number == types.boolean else manager.lookup(kind.number).get_value_type()
        super().__init__(manager, kind, ir.VectorType(element, kind.width))


MASK = Lanes(types.boolean)


def _intrinsic(function: Callable[..., Any]) -> Callable[..., Any]:
    return cast(Callable[..., Any], intrinsic(function))


def _broadcast(context: Any, builder: Any, value: Any, kind: Any, lanes: Lanes) -> Any:
    """Broadcast a scalar to all lanes; return lanes unchanged."""
    if isinstance(kind, Lanes):
        return value
    number = context.cast(builder, value, kind, lanes.number)
    undefined = ir.Constant(ir.VectorType(number.type, lanes.width), ir.Undefined)
    first = builder.insert_element(undefined, number, ir.Constant(_WORD, 0))
    return _shuffled(builder, first, undefined, [0] * lanes.width)


def _shuffled(builder: Any, a: Any, b: Any, places: Sequence[int]) -> Any:
    """Shuffle lanes of ``a``, numbered from 0, and of ``b``, numbered from 16."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_WORD, len(places)), list(places)))


def _lane_by_lane(operands: Sequence[Any], write: Callable[..., Any], result: Lanes | None = None) -> Any:
    """Signature and code generator of an elementwise intrinsic, from ``write(builder, *lanes)``; None without lanes."""
    lanes = min((kind for kind in operands if isinstance(kind, Lanes)), key=MASK.__eq__, default=None)
    if lanes is None:
        return None

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        broadcast = [
            value if kind == MASK else _broadcast(context, builder, value, kind, lanes)
            for value, kind in zip(arguments, operands)
        ]
        return write(builder, *broadcast)

    return (result or lanes)(*operands), generate


def _operator(function: Callable[..., Any], write: Callable[..., Any], result: Lanes | None = None) -> None:
    """Define an operator that takes lanes on one side or on both."""

    @_intrinsic
    def action(typing: Any, a: Any, b: Any) -> Any:
        return _lane_by_lane((a, b), write, result)

    @overload(function)
    def implementation(a: Any, b: Any) -> Any:
        def call(a: Any, b: Any) -> Any:
            return action(a, b)

        return call if isinstance(a, Lanes) or isinstance(b, Lanes) else None


def _by_kind(integer: str, real: str, *sign: str) -> Callable[..., Any]:
    """Code generator of an instruction for whole numbers or for floats; of a comparison by its sign."""
    return lambda builder, a, b: getattr(builder, integer if a.type.element == _WORD else real)(*sign, a, b)


_compared = partial(_by_kind, "icmp_signed", "fcmp_ordered")
_operator(operator.add, _by_kind("add", "fadd"))
_operator(operator.sub, _by_kind("sub", "fsub"))
_operator(operator.mul, _by_kind("mul", "fmul"))
_operator(operator.truediv, lambda builder, a, b: builder.fdiv(a, b))
_operator(operator.rshift, lambda builder, a, b: builder.ashr(a, b))
_operator(operator.and_, lambda builder, a, b: builder.and_(a, b))
_operator(operator.lt, _compared("<"), MASK)
_operator(operator.gt, _compared(">"), MASK)
_operator(operator.ge, _compared(">="), MASK)


@_intrinsic
def any_lane(typing: Any, mask: Any) -> Any:
    """Whether any lane is true."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bits = builder.bitcast(arguments[0], ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(mask), generate


@_intrinsic
def select(typing: Any, mask: Any, a: Any, b: Any) -> Any:
    """``a`` where the mask is true, else ``b``; one of the two may be a scalar."""
    # Behind a fence, or LLVM stores under the mask where b was loaded, which takes forty operations of AMD's Zen 3.
    return _lane_by_lane((mask, a, b), lambda to, mask, a, b: to.select(mask, a, _call(to, "arithmetic.fence", b)))


@_intrinsic
def minimum(typing: Any, a: Any, b: Any) -> Any:
    """The smaller of the two; ``b`` where one is NaN."""
    return _lane_by_lane((a, b), lambda builder, a, b: builder.select(_compared("<")(builder, a, b), a, b))


@_intrinsic
def absolute(typing: Any, a: Any) -> Any:
    """The absolute value."""
    return _lane_by_lane((a,), lambda builder, a: _call(builder, "fabs", a))


@_intrinsic
def fma(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """``a * b + c``, rounded once."""
    return _lane_by_lane((a, b, c), lambda builder, *three: _call(builder, "fma", *three))


def _call(builder: Any, name: str, *lanes: Any) -> Any:
    """Call one of LLVM's vector intrinsics."""
    kind = lanes[0].type
    suffix = f"v{WIDTH}f{32 if isinstance(kind.element, ir.FloatType) else 64}"
    signature = ir.FunctionType(kind, [kind] * len(lanes))
    return builder.call(cgutils.get_or_insert_function(builder.module, signature, f"llvm.{name}.{suffix}"), lanes)


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Address of an element of a C-contiguous array, as a pointer to lanes."""
    data = arrayobj.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), context.get_value_type(Lanes(kind.dtype)).as_pointer())


@_intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """Load the lanes of a C-contiguous array, from flat ``index`` on. Bounds are not checked."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_address(context, builder, array, *arguments), align=array.dtype.bitwidth // 8)

    return Lanes(array.dtype)(array, types.intp), generate


@_intrinsic
def store(typing: Any, array: Any, index: Any, values: Any) -> Any:
    """Store lanes where :func:`load` would read them."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.store(arguments[2], _address(context, builder, array, *arguments[:2]), align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, values), generate


@_intrinsic
def zeros(typing: Any, array: Any) -> Any:
    """Lanes of zeros, of the dtype of an array."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return ir.Constant(context.get_value_type(signature.return_type), None)

    return Lanes(array.dtype)(array), generate


@_intrinsic
def store_sums(typing: Any, array: Any, index: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Store four sums over lanes side by side; each adds its halves first, then neighbours, pairs, quadruples."""
    rows = (a, b, c, d)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        sums = [
            builder.fadd(_shuffled(builder, row, row, range(8)), _shuffled(builder, row, row, range(8, 16)))
            for row in arguments[2:]
        ]
        for size in (1, 2):
            # Interleave blocks of `size` numbers of two rows.
            first = [row * 8 + block + i for block in range(0, 8, 2 * size) for row in (0, 1) for i in range(size)]
            second = [lane + size for lane in first]
            sums = [
                builder.fadd(_shuffled(builder, a, b, first), _shuffled(builder, a, b, second))
                for a, b in zip(sums[::2], sums[1::2])
            ]
        total = builder.fadd(*(_shuffled(builder, sums[0], sums[0], range(i, i + 4)) for i in (0, 4)))
        data = _address(context, builder, array, *arguments[:2])
        builder.store(total, builder.bitcast(data, total.type.as_pointer()), align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, *rows), generate


@_intrinsic
def exp_negative(typing: Any, x: Any) -> Any:
    """exp(-x) for lanes between 0 and 80, within one and a half units in the last place."""
    # 2^n exp(-r), with n the integer nearest to -x / log(2), and a Taylor series in r, which is at most log(2) / 2.

    def write(builder: Any, x: Any) -> Any:
        single = isinstance(x.type.element, ir.FloatType)
        mantissa, terms = (23, 8) if single else (52, 14)
        # log(2) in two parts; the first has so few bits that its product with n is exact.
        high, low = (0.693359375, -2.12194440e-4) if single else (0.693147180369123816490, 1.90821492927058770002e-10)

        def constant(value: float) -> Any:
            return ir.Constant(x.type, [value] * WIDTH)

        # Adding a number this large rounds -x / log(2) to an integer, held in the lowest bits.
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
