"""Arguments of a kernel that stay the same from call to call, taken apart once.

numba takes a tuple of arrays apart at every call, a tenth of a microsecond and more for each array. ``Held`` does it
once, and a kernel refers to the result (``sensors.reference``): for calls that are many and short.
"""

from typing import Any, Generic, TypeVar

import numba
import numpy as np
from numba.core import types
from numba.extending import NativeValue, intrinsic, models, register_model, typeof_impl, unbox

from sensors.kernel import kernel
from sensors.reference import Reference

Value = TypeVar("Value")


class Held(Generic[Value]):
    """A named tuple of numbers, arrays and named tuples, as kernels see it: its arrays can be written to."""

    def __init__(self, value: Value) -> None:
        self.value = value
        self.numba_type = HeldType(numba.typeof(value))
        self._memory = np.zeros(_size(value), np.uint8)
        self.address = int(self._memory.ctypes.data)
        _write(value, self.address)


class HeldType(types.Type):  # type: ignore[misc]
    """numba's type of Held."""

    def __init__(self, value: types.Type) -> None:
        self.value = value
        super().__init__(f"Held({value})")


@typeof_impl.register(Held)  # type: ignore[untyped-decorator]
def _typeof(held: Held[Any], context: Any) -> HeldType:
    return held.numba_type


@register_model(HeldType)
class _Model(models.OpaqueModel):  # type: ignore[misc]
    """An address."""


@unbox(HeldType)  # type: ignore[untyped-decorator]
def _unbox(kind: HeldType, held: Any, compiling: Any) -> NativeValue:
    number = compiling.pyapi.object_getattr_string(held, "address")
    address = compiling.pyapi.long_as_voidptr(number)
    compiling.pyapi.decref(number)
    return NativeValue(address)


@intrinsic  # type: ignore[untyped-decorator]
def refer(typing: Any, held: Any) -> Any:
    """The named tuple that is held, by reference. Within a kernel."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return arguments[0]

    return (Reference(held.value)(held), generate) if isinstance(held, HeldType) else None


@intrinsic  # type: ignore[untyped-decorator]
def _sizeof(typing: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return context.get_constant(types.intp, context.get_abi_sizeof(context.get_data_type(value)))

    return types.intp(value), generate


@intrinsic  # type: ignore[untyped-decorator]
def _pack(typing: Any, value: Any, address: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        packed, at = arguments
        context.pack_value(builder, value, packed, builder.inttoptr(at, context.get_data_type(value).as_pointer()))
        return context.get_dummy_value()

    return types.none(value, types.intp), generate


@kernel()
def _size(value: Any) -> int:
    size: int = _sizeof(value)
    return size


@kernel()
def _write(value: Any, address: int) -> None:
    _pack(value, address)
