"""Software prefetch for compiled code, so that cache misses overlap."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


@intrinsic
def prefetch(_context: Any, array: Any, row: Any, column: Any) -> Any:
    """Prefetch ``array[row, column]``, both in range; for compiled code only. Has no effect on results."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = signature.args[0]
        values = context.make_array(kind)(context, builder, arguments[0])
        indices = [
            context.cast(builder, value, given, types.intp)
            for value, given in zip(arguments[1:], signature.args[1:], strict=True)
        ]
        item = cgutils.get_item_pointer(context, builder, kind, values, indices, wraparound=False)
        address = builder.bitcast(item, cgutils.voidptr_t)
        number = ir.IntType(32)
        parameters = [cgutils.voidptr_t, number, number, number]
        announce = builder.module.declare_intrinsic(
            "llvm.prefetch", [cgutils.voidptr_t], ir.FunctionType(ir.VoidType(), parameters)
        )
        builder.call(announce, [address, number(0), number(3), number(1)])  # to read, keep, data cache
        return context.get_dummy_value()

    return types.none(array, row, column), generate
