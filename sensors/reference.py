"""Named tuples of arrays and numbers, handed from kernel to kernel by their address.

numba passes a named tuple by value, field by field: thirty arrays are three hundred arguments of every call, and most
of the time that a kernel takes to compile. A kernel that Python calls refers to what it was given once, and hands that
on. Fields read the same from both, so what is called cannot tell, and Python may call it with the tuple itself.
"""

import hashlib
from functools import cache
from typing import Any, NamedTuple, TypeVar

from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, lower_builtin, lower_getattr_generic, register_model, type_callable

Named = TypeVar("Named", bound=NamedTuple)


class Reference(types.Type):  # type: ignore[misc]
    """The address of a named tuple, valid while the kernel that referred to it runs."""

    def __init__(self, target: types.BaseNamedTuple) -> None:
        self.target = target
        # short, since it becomes part of every name; arrays of other kinds make it another type
        digest = hashlib.sha256(target.name.encode()).hexdigest()[:12]
        super().__init__(name=f"Reference({target.instance_class.__name__} {digest})")


@register_model(Reference)
class _ReferenceModel(models.PrimitiveModel):  # type: ignore[misc]
    """A plain address: the layout of thirty arrays would be spelled out wherever it is mentioned."""

    def __init__(self, manager: Any, reference: Reference) -> None:
        super().__init__(manager, reference, cgutils.voidptr_t)


def by_reference(value: Named) -> Named:
    """Refer to a named tuple; in a loop it is another one every time, at the same place. In plain Python: itself."""
    return value


@type_callable(by_reference)  # type: ignore[untyped-decorator]
def _reference_to(_context: Any) -> Any:
    def typed(value: Any) -> Any:
        if isinstance(value, Reference):
            return value
        return Reference(value) if isinstance(value, types.BaseNamedTuple) else None

    return typed


@lower_builtin(by_reference, types.BaseNamedTuple)  # type: ignore[untyped-decorator]
def _refer(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    model = context.data_model_manager[signature.args[0]]
    place = cgutils.alloca_once_value(builder, model.as_data(builder, args[0]))
    return builder.bitcast(place, cgutils.voidptr_t)


@lower_builtin(by_reference, Reference)  # type: ignore[untyped-decorator]
def _same(_context: Any, _builder: Any, _signature: Any, args: Any) -> Any:
    return args[0]


@infer_getattr
class _Fields(AttributeTemplate):  # type: ignore[misc]
    """A field has its own type; a named tuple within is referred to as well."""

    key = Reference

    def generic_resolve(self, reference: Reference, field: str) -> Any:
        if field not in reference.target.fields:
            return None
        found = reference.target.types[reference.target.fields.index(field)]
        return Reference(found) if isinstance(found, types.BaseNamedTuple) else found


@lower_getattr_generic(Reference)  # type: ignore[untyped-decorator]
def _read(context: Any, builder: Any, reference: Reference, address: Any, field: str) -> Any:
    place = reference.target.fields.index(field)
    found = reference.target.types[place]
    offset = _offsets(context.get_data_type(reference.target), context.target_data)[place]
    at = builder.gep(address, [cgutils.intp_t(offset)], inbounds=True)
    if isinstance(found, types.BaseNamedTuple):
        return at
    model = context.data_model_manager[found]
    return model.load_from_data_pointer(builder, builder.bitcast(at, model.get_data_type().as_pointer()))


@cache
def _offsets(layout: Any, target_data: Any) -> list[int]:
    """Bytes from the beginning of a tuple to each field. layout: its LLVM type, an array where all have one type."""
    if hasattr(layout, "count"):
        return [i * layout.element.get_abi_size(target_data) for i in range(layout.count)]
    return [layout.get_element_offset(target_data, i) for i in range(len(layout.elements))]
