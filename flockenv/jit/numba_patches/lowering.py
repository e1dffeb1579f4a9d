"""A shorter lowering of numba: LLVM code for arrays, loops and calls without what LLVM would remove again.

Half of the compile time of a kernel went into writing LLVM code, parsing it and removing redundancy: numba stores all
fields of an array for each number that is read from it, and for each call unpacks a namedtuple of twenty arrays into
two hundred arguments, which the called function packs again. Here a number is read directly from the array's data, a
view is built only from the fields that differ, a loop with step 1 needs no division, and a function that is only ever
inlined receives a namedtuple as one argument. Flock in float64 has 33,000 instructions instead of 86,000; the machine
code is the same.

This lowering is not used if the functions of numba that it relies on differ (another version); see `front_end`.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

from llvmlite import ir as llvm  # type: ignore[import-untyped]
from numba.core import base, callconv, cgutils, imputils, ir, lowering, types
from numba.core.datamodel import models
from numba.cpython import rangeobj, slicing
from numba.np import arrayobj

from flockenv.jit.numba_patches.front_end import Known, applies

__all__ = ["READS", "Brief", "BriefPart", "insert_part", "is_brief"]

# numba is untyped
_Lower: Any = lowering.Lower
_Convention: Any = callconv.CPUCallConv
_arrays: Any = arrayobj
_code: Any = cgutils
_Tuple: Any = types.BaseTuple

LOOPS = ("getiter", "iternext", "pair_first", "pair_second")

START_STOP_STEP = 3
"""Number of fields of a range: start, stop, step."""

READS = (
    Known(_Lower, "storevar", "16d897dd729a"),
    Known(_Lower, "delvar", "45cd88aeddd8"),
    Known(_Lower, "lower_getitem", "76f8c6ed4f7e"),
    Known(_Lower, "lower_setitem", "84ed9f0254ea"),
    Known(_Lower, "lower_expr", "581164cc7697"),
    Known(_Lower, "lower_inst", "e479506025a2"),
    Known(_Lower, "_lower_call_normal", "ff84f88a6d07"),
    Known(_Lower, "_lower_call_RecursiveCall", "e524c8215ce3"),
    Known(_Lower, "fold_call_args", "c60d73f5e902"),
    Known(_Lower, "pre_block", "1046a20a6c65"),
    Known(_Lower, "loadvar", "dc1f6093a614"),
    Known(_Lower, "_alloca_var", "754db57f46d1"),
    Known(_Lower, "_find_singly_assigned_variable", "64279ab677bd"),
    Known(lowering.BaseLower, "setup_function", "c346418a1cf3"),
    Known(lowering.BaseLower, "extract_function_arguments", "9f22441a3786"),
    Known(base.BaseContext, "declare_function", "27a68dc93976"),
    Known(_Convention, "get_function_type", "7b4264fd7561"),
    Known(_Convention, "decorate_function", "40a0fcb5401f"),
    Known(_Convention, "call_function", "63b21494a809"),
    Known(_Convention, "return_status_propagate", "9af41fdd6e4e"),
    Known(_Convention, "check_try_status", "b2d609fe391b"),
    Known(_Convention, "_get_return_status", "6b2ffbd96fb5"),
    Known(imputils, "user_function", "38735fa51cb4"),
    Known(rangeobj, "make_range_impl", "3b198b25a32e"),
    Known(slicing, "fix_slice", "d25bf3efcb56"),
    Known(slicing, "get_slice_length", "e2acd9d22919"),
    Known(slicing, "fix_stride", "f438b3e7fee0"),
    Known(cgutils, "get_item_pointer2", "7b168f0b301f"),
    Known(arrayobj, "basic_indexing", "6000a5433cca"),
    Known(arrayobj, "setitem_array", "fb4c1ebc03a9"),
    Known(arrayobj, "make_view", "cff36d1e408f"),
    Known(arrayobj, "populate_array", "e86886c14bfc"),
    Known(arrayobj, "fix_integer_index", "05fc2c98f472"),
    Known(models.BooleanModel, "as_data", "990f642ab9f5"),
    Known(models.BooleanModel, "as_return", "396fdd0e787b"),
    Known(models.ArrayModel, "__init__", "cbe7f8d3a4e8"),
    Known(models.PairModel, "__init__", "ec2b0a14e74e"),
    Known(models.RangeModel, "__init__", "4f349fad5728"),
    Known(models.RangeIteratorType, "__init__", "65c87b5a27d1"),
)
"""Functions of numba that are replaced, or that the replacements rely on."""


@functools.cache
def is_brief() -> bool:
    """Return True if this lowering is used: numba's source is as tested, and LEFT_OUT does not exclude it."""
    return applies("lowering", READS)


class Brief(_Lower):  # type: ignore[misc]
    """Lowering of a function; code with reference counting is left to numba."""

    def storevar(self, value: Any, name: str, argidx: Any = None) -> None:
        """Store a value: without reference counts, the old value needs no decref."""
        self._alloca_var(name, self.typeof(name))
        if self.context.enable_nrt or self._disable_sroa_like_opt:
            super().storevar(value, name, argidx)
        elif name in self._singly_assigned_vars:
            self._blk_local_varmap[name] = value
        else:
            self.builder.store(value, self.getvar(name))

    def delvar(self, name: str) -> None:
        """Delete a variable, without code for reference counts."""
        if self.context.enable_nrt or self._disable_sroa_like_opt:
            super().delvar(name)
        elif name not in self._blk_local_varmap:
            self._singly_assigned_vars.discard(name)
            self._alloca_var(name, self.typeof(name))

    def lower_getitem(self, resty: Any, expr: Any, value: Any, index: Any, signature: Any) -> Any:
        """Read a number of an array directly, or make a view of a part; leave everything else to numba."""
        kind = self.typeof(value.name)
        places = self._axis_indices(kind, index)
        if places is None or not (resty == kind.dtype or isinstance(resty, types.Array)):
            return super().lower_getitem(resty, expr, value, index, signature)
        return self._view(kind, resty, self.loadvar(value.name), places, index)

    def lower_setitem(self, target_var: Any, index_var: Any, value_var: Any, signature: Any) -> Any:
        """Write a number of an array directly; leave everything else to numba."""
        kind, given = self.typeof(target_var.name), self.typeof(value_var.name)
        places = self._axis_indices(kind, index_var) if isinstance(given, (types.Number, types.Boolean)) else None
        if places is None or len(places) < kind.ndim or any(isinstance(place, slice) for place in places):
            return super().lower_setitem(target_var, index_var, value_var, signature)
        value = self.context.cast(self.builder, self.loadvar(value_var.name), given, signature.args[2])
        value = self.context.cast(self.builder, value, signature.args[2], kind.dtype)
        array = self.loadvar(target_var.name)
        where = self._address(kind, array, [each for each, _ in self._spans(kind, array, places, index_var)])
        _arrays.store_item(self.context, self.builder, kind, value, where)
        return None

    def _axis_indices(self, kind: Any, index: Any) -> tuple[Any, ...] | None:
        """Return the index of each axis: the type of an integer, or a slice with literal bounds.

        Return None if the array or the index is of any other kind.
        """
        given: Any = self.typeof(index.name)
        if not isinstance(kind, types.Array) or kind.layout not in "CA":
            return None
        if self.context.enable_nrt or self.context.enable_boundscheck:
            return None
        if not isinstance(kind.dtype, (types.Number, types.Boolean)):
            return None
        each = given.types if isinstance(given, _Tuple) else (given,)
        places = tuple(
            self._slice(index, k, len(each)) if isinstance(g, types.SliceType) else g for k, g in enumerate(each)
        )
        known = all(isinstance(place, (types.Integer, slice)) for place in places)
        return places if known and 0 < len(places) <= kind.ndim else None

    def _slice(self, index: Any, place: int, many: int) -> slice | None:
        """Return a slice with literal, non-negative bounds and no step; None if it is another."""
        known = self._definition(index)
        if isinstance(known, tuple):
            known = known[place]
        elif isinstance(known, ir.Expr) and known.op == "build_tuple":
            known = self._definition(known.items[place])
        elif many > 1:
            return None
        if self._is_call_of(known, slice) and not known.vararg:
            known = slice(*(self._definition(argument) for argument in known.args))
        if not isinstance(known, slice) or known.step is not None:
            return None
        ends = [end for end in (known.start, known.stop) if end is not None]
        return known if all(type(end) is int and 0 <= end <= types.intp.maxval for end in ends) else None

    def _is_call_of(self, made: Any, function: Any) -> bool:
        """Return True if the definition of a variable is a call of a Python function."""
        if not isinstance(made, ir.Expr) or made.op != "call":
            return False
        return getattr(self.typeof(made.func.name), "typing_key", None) is function

    def _definition(self, variable: Any) -> Any:
        """Return the constant value of a variable, or its definition; the variable itself if it has several."""
        try:
            made = self.func_ir.get_definition(variable)
        except KeyError:
            return variable
        return made.value if isinstance(made, (ir.Const, ir.Global, ir.FreeVar)) else made

    def _view(self, kind: Any, result: Any, array: Any, places: tuple[Any, ...], index: Any) -> Any:
        """Return a number of an array, or a view of a part of it."""
        builder = self.builder
        spans = self._spans(kind, array, (*places, *[slice(None)] * (kind.ndim - len(places))), index)
        where = self._address(kind, array, [first for first, _ in spans])
        if result == kind.dtype:
            return _arrays.load_item(self.context, builder, kind, where)
        strides = self._part(kind, array, "strides")
        sizes = [size for _, size in spans if size is not None]
        steps = [builder.extract_value(strides, axis) for axis, (_, size) in enumerate(spans) if size is not None]
        parts = {name: self._part(kind, array, name) for name in ("meminfo", "parent", "itemsize")}
        view, model = self.context.get_value_type(result), self.context.data_model_manager[result]
        parts |= {"nitems": functools.reduce(builder.mul, sizes), "data": where}
        for name, numbers in (("shape", sizes), ("strides", steps)):
            parts[name] = _struct(builder, view.elements[model.get_field_position(name)], numbers)
        return _struct(builder, view, [parts[name] for name in sorted(parts, key=model.get_field_position)])

    def _part(self, kind: Any, array: Any, name: str) -> Any:
        return self.builder.extract_value(array, self.context.data_model_manager[kind].get_field_position(name))

    def _spans(self, kind: Any, array: Any, places: tuple[Any, ...], index: Any) -> list[tuple[Any, Any]]:
        """Return (first, size) of each axis; first is None for 0, size is None for an integer, which drops the axis."""
        context, builder, found = self.context, self.builder, []
        for axis, place in enumerate(places):

            def size(axis: int = axis) -> Any:
                return builder.extract_value(self._part(kind, array, "shape"), axis)

            if isinstance(place, slice):
                found.append(_slice_bounds(builder, size(), place.start or 0, place.stop))
                continue
            at = self.loadvar(index.name)
            if isinstance(self.typeof(index.name), types.BaseTuple):
                at = builder.extract_value(at, axis)
            at = context.cast(builder, at, place, types.intp if place.signed else types.uintp)
            if place.signed:  # negative indices count from the end
                negative = builder.icmp_signed("<", at, at.type(0))
                at = builder.select(negative, builder.add(at, size()), at)
            found.append((at, None))
        return found

    def _address(self, kind: Any, array: Any, firsts: list[Any]) -> Any:
        """Return the address of a number of an array; None as an index means 0."""
        builder, data = self.builder, self._part(kind, array, "data")
        name = "shape" if kind.layout == "C" else "strides"
        numbers = self._part(kind, array, name) if kind.layout != "C" or len(firsts) > 1 else None
        at: Any = None
        for axis, first in enumerate(firsts):
            if kind.layout == "C":
                if axis > 0 and at is not None:
                    at = builder.mul(at, builder.extract_value(numbers, axis))
                step = first
            else:
                step = None if first is None else builder.mul(builder.extract_value(numbers, axis), first)
            if step is not None:
                at = step if at is None else builder.add(at, step)
        if at is None:
            return data
        return builder.gep(data, [at]) if kind.layout == "C" else _code.pointer_add(builder, data, at)

    def lower_expr(self, resty: Any, expr: Any) -> Any:
        """Lower iteration over a `range` with step 1 to short code; leave every other expression to numba."""
        kind = self.typeof(expr.value.name) if expr.op in LOOPS else None
        if isinstance(kind, types.RangeType) and expr.op == "getiter" and self._has_step_one(expr.value):
            return self._range_iterator(kind, self.loadvar(expr.value.name))
        if isinstance(kind, types.RangeIteratorType) and expr.op == "iternext":
            return self._next(resty, self.loadvar(expr.value.name))
        if isinstance(kind, types.Pair) and not self.context.enable_nrt:
            place = ("pair_first", "pair_second").index(expr.op)
            return self.builder.extract_value(self.loadvar(expr.value.name), place)
        return super().lower_expr(resty, expr)

    def _has_step_one(self, variable: Any) -> bool:
        """Return True if a variable is a `range` of one or two arguments, with step 1."""
        call = self._definition(variable)
        return self._is_call_of(call, range) and len(call.args) < START_STOP_STEP and not call.vararg

    def _range_iterator(self, kind: Any, numbers: Any) -> Any:
        """Return the iterator of a range: pointer to the next number, end, step, pointer to the count left."""
        builder = self.builder
        start, stop, step = (builder.extract_value(numbers, place) for place in range(START_STOP_STEP))
        with builder.goto_entry_block():
            following, left = builder.alloca(start.type), builder.alloca(start.type)
        builder.store(start, following)
        many = builder.sub(stop, start)
        some = builder.icmp_signed(">", many, many.type(0))
        with builder.if_else(some) as (then, otherwise):
            with then:
                builder.store(many, left)
            with otherwise:
                builder.store(many.type(0), left)
        loop = self.context.get_value_type(kind.iterator_type)
        return _struct(builder, loop, (following, stop, step, left))

    def _next(self, pair: Any, loop: Any) -> Any:
        """Return the pair (next number, True), or (0, False) at the end."""
        builder = self.builder
        following, _, step, left = (builder.extract_value(loop, place) for place in range(len(loop.type)))
        many = builder.load(left)
        some = builder.icmp_signed(">", many, many.type(0))
        with builder.goto_entry_block():
            found = builder.alloca(many.type)
            builder.store(many.type(0), found)
        with builder.if_then(some):
            number = builder.load(following)
            builder.store(number, found)
            builder.store(builder.sub(many, many.type(1), flags=["nsw"]), left)
            builder.store(builder.add(number, step), following)
        return _struct(builder, self.context.get_value_type(pair), (builder.load(found), some))

    def _lower_call_normal(self, fnty: Any, expr: Any, signature: Any) -> Any:
        """Lower a call of `range`; leave every other call to numba."""
        if getattr(fnty, "typing_key", None) is not range or len(signature.args) >= START_STOP_STEP:
            return super()._lower_call_normal(fnty, expr, signature)
        *start, stop = self.fold_call_args(fnty, signature, expr.args, expr.vararg, expr.kws)
        kind = self.context.get_value_type(signature.return_type)
        return _struct(self.builder, kind, (*(start or [stop.type(0)]), stop, stop.type(1)))


def _struct(builder: Any, kind: Any, parts: Sequence[Any]) -> Any:
    whole = llvm.Constant(kind, llvm.Undefined)
    for place, part in enumerate(parts):
        whole = builder.insert_value(whole, part, place)
    return whole


def _slice_bounds(builder: Any, size: Any, start: int, stop: int | None) -> tuple[Any, Any]:
    """Return the first index of a slice of an axis, None for 0, and its length."""

    def least(number: int) -> Any:
        return builder.select(builder.icmp_signed("<", size, size.type(number)), size, size.type(number))

    end = size if stop is None else least(stop)
    if start == 0:
        return None, end  # the size itself for a whole axis
    first = least(start)
    long = builder.sub(end, first)
    return first, builder.select(builder.icmp_signed("<", long, long.type(0)), long.type(0), long)


def _is_passed_directly(fndesc: Any) -> bool:
    """Return True if a function can receive its arguments without unpacking.

    It cannot if it has omitted defaults, which have no value, or is recursive: numba treats such calls differently.
    """
    left_out = any(isinstance(kind, types.Omitted) for kind in fndesc.argtypes)
    return not left_out and not any(isinstance(kind, types.RecursiveCall) for kind in fndesc.typemap.values())


class BriefPart(Brief):
    """Lowering of a function that only compiled code calls."""

    def setup_function(self, fndesc: Any) -> None:
        """Create the function, its entry block and its builder."""
        if not _is_passed_directly(fndesc):
            super().setup_function(fndesc)
            return
        self.function = _declare(self.context, self.module, fndesc)
        self.entry_block = self.function.append_basic_block("entry")
        self.builder = llvm.IRBuilder(self.entry_block)
        self.call_helper = self.call_conv.init_call_helper(self.builder)

    def extract_function_arguments(self) -> Any:
        """Set the function's arguments as they are, without packing them."""
        if not _is_passed_directly(self.fndesc):
            return super().extract_function_arguments()
        self.fnargs = list(self.call_conv.get_arguments(self.function))
        return self.fnargs


def _declare(context: Any, module: Any, fndesc: Any) -> Any:
    """Declare a function like numba, except that its arguments are not unpacked."""
    convention = context.call_conv
    known = convention.get_function_type(fndesc.restype, ())
    arguments = [context.get_value_type(kind) for kind in fndesc.argtypes]
    function = _code.get_or_insert_function(
        module, llvm.FunctionType(known.return_type, [*known.args, *arguments]), fndesc.mangled_name
    )
    for argument, name in zip(function.args, ("retptr", "excinfo", *fndesc.args), strict=False):
        argument.name = name
    for argument in function.args[: len(known.args)]:
        argument.add_attribute("captures(none)")
        argument.add_attribute("noalias")
    if fndesc.inline:
        function.attributes.add("alwaysinline")
    return function


def _flag(builder: Any, byte: Any) -> Any:
    """Return the flag of a byte that a function returned: 0 or 1.

    numba compares it with 0 in a branch. LLVM then inverts the condition of a masked sum, which becomes an addition and
    a selection: a loop over neighbours took a seventh longer.
    """
    return builder.trunc(byte, llvm.IntType(1))


def insert_part(context: Any, function: Any, fndesc: Any, libraries: tuple[Any, ...]) -> None:
    """Register a function for its callers, like numba's `insert_user_function`, but with arguments not unpacked."""
    if not _is_passed_directly(fndesc):
        context.insert_user_function(function, fndesc, libraries)
        return

    def call(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        convention = context.call_conv
        called = _declare(context, builder.module, fndesc)
        error_type = llvm.PointerType(callconv.excinfo_t)
        with builder.goto_entry_block():
            result = builder.alloca(convention.get_return_type(fndesc.restype).pointee)
            error = builder.alloca(error_type)
        builder.store(error_type(None), error)
        code = builder.call(called, [result, error, *args])
        if isinstance(fndesc.restype, types.Optional) or hasattr(builder, "_in_try_block"):
            status = convention._get_return_status(builder, code, builder.load(error))
            with _code.if_unlikely(builder, status.is_error):
                convention.return_status_propagate(builder, status)
            value = context.get_returned_value(builder, fndesc.restype, builder.load(result))
            fix: Any = imputils.fix_returning_optional
            return fix(context, builder, sig, status, value)
        with _code.if_unlikely(builder, builder.icmp_signed("!=", code, callconv.RETCODE_OK)):
            builder.store(builder.load(error), convention._get_excinfo_argument(builder.function))
            builder.ret(code)  # the caller propagates the error
        returned = builder.load(result)
        if fndesc.restype == types.boolean:
            return _flag(builder, returned)
        return context.get_returned_value(builder, fndesc.restype, returned)

    call.signature = fndesc.argtypes  # type: ignore[attr-defined]
    call.libs = libraries  # type: ignore[attr-defined]
    context._defns[function].append(call, call.signature)  # type: ignore[attr-defined]
