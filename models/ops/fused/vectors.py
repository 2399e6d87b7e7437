"""A vector of neighbouring float32 values as a type of compiled code.

The compiler finds vector instructions for simple loops by itself, but keeps sums in memory where a kernel
works best with a dozen of them in registers. Here kernels say what they mean: a `Float32s` holds `LANES`
values, is read from and written to a contiguous array at a flat index, and lives in a register.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc"
from __future__ import annotations

from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

LANES = 16 if binding.get_host_cpu_features().get("avx512f", False) else 8
"""Values of a vector: two registers on machines with registers of 4, so that sums still fit."""

_FLOAT = ir.FloatType()
_FLOATS = ir.VectorType(_FLOAT, LANES)
_DOUBLES = ir.VectorType(ir.DoubleType(), LANES)


class Float32s(types.Type):
    """`LANES` values of float32."""

    def __init__(self) -> None:
        super().__init__(name=f"Float32s({LANES})")


vector = Float32s()


@register_model(Float32s)
class _Float32sModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _FLOATS)


def _place(
    context: Any, builder: Any, array_type: Any, array: Any, index: Any, kind: ir.VectorType = _FLOATS
) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), kind.as_pointer())


@intrinsic
def load(typing_context: Any, array: Any, index: Any) -> Any:
    """Return the values from a flat index of a contiguous array on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_place(context, builder, signature.args[0], *arguments), align=4)

    return vector(array, types.intp), generate


@intrinsic
def store(typing_context: Any, array: Any, index: Any, values: Any) -> Any:
    """Write the values from a flat index of a contiguous array on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = _place(context, builder, signature.args[0], *arguments[:2])
        builder.store(arguments[2], place, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate


@intrinsic
def add_to_doubles(typing_context: Any, array: Any, index: Any, values: Any) -> Any:
    """Add the values to those of a contiguous float64 array from a flat index on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array_type, (data, start) = signature.args[0], arguments[:2]
        place = _place(context, builder, array_type, data, start, _DOUBLES)
        wide = builder.fpext(arguments[2], _DOUBLES)
        builder.store(builder.fadd(builder.load(place, align=8), wide), place, align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate


@intrinsic
def repeated(typing_context: Any, value: Any) -> Any:
    """Return a vector of one value."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        undefined = ir.Constant(_FLOATS, ir.Undefined)
        first = builder.insert_element(undefined, arguments[0], ir.Constant(ir.IntType(32), 0))
        lanes = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return builder.shuffle_vector(first, undefined, lanes)

    return vector(types.float32), generate


@intrinsic
def product(typing_context: Any, a: Any, b: Any) -> Any:
    """Return a b."""
    return vector(vector, vector), lambda context, builder, signature, given: builder.fmul(*given)


@intrinsic
def difference(typing_context: Any, a: Any, b: Any) -> Any:
    """Return a - b."""
    return vector(vector, vector), lambda context, builder, signature, given: builder.fsub(*given)


@intrinsic
def total(typing_context: Any, a: Any, b: Any) -> Any:
    """Return a + b."""
    return vector(vector, vector), lambda context, builder, signature, given: builder.fadd(*given)


@intrinsic
def quotient(typing_context: Any, a: Any, b: Any) -> Any:
    """Return a / b."""
    return vector(vector, vector), lambda context, builder, signature, given: builder.fdiv(*given)


@intrinsic
def smaller(typing_context: Any, a: Any, b: Any) -> Any:
    """Return the smaller of a and b, b where a is not a number."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", *arguments), *arguments)

    return vector(vector, vector), generate


@intrinsic
def powers_of_two(typing_context: Any, shifted: Any) -> Any:
    """Return 2**n from 1.5 * 2**23 + n, whose lowest bits are n."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        integers = ir.VectorType(ir.IntType(32), LANES)
        bits = builder.shl(builder.bitcast(arguments[0], integers), ir.Constant(integers, [23] * LANES))
        bits = builder.add(bits, ir.Constant(integers, [127 << 23] * LANES))
        return builder.bitcast(bits, _FLOATS)

    return vector(vector), generate


@intrinsic
def below(typing_context: Any, a: Any, limit: Any, values: Any) -> Any:
    """Return the values where a is below the limit, 0 elsewhere."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        a, limit, values = arguments
        return builder.select(
            builder.fcmp_ordered("<", a, limit), values, ir.Constant(_FLOATS, [0.0] * LANES)
        )

    return vector(vector, vector, vector), generate


@intrinsic
def product_added(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a b + c, rounded once where the machine can."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(_FLOATS, [_FLOATS] * 3)
        name = f"llvm.fmuladd.v{LANES}f32"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)

    return vector(vector, vector, vector), generate


@intrinsic
def any_positive(typing_context: Any, a: Any) -> Any:
    """Say whether a value is above 0."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        above = builder.fcmp_ordered(">", arguments[0], ir.Constant(_FLOATS, [0.0] * LANES))
        bits = ir.IntType(LANES)
        return builder.icmp_unsigned("!=", builder.bitcast(above, bits), ir.Constant(bits, 0))

    return types.boolean(vector), generate
