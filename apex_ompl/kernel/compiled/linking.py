"""How numba compiles functions that only other compiled ones call: their code is linked into that of their callers.

By itself numba optimises every function together with all that it calls, and makes machine code of it; a function that
is called through five others is optimised six times. Here functions that Python never calls are left as they are
lowered, and each function that Python calls is optimised once, with all that was linked into it.
"""

from __future__ import annotations

import ctypes
from typing import Any

from llvmlite import binding as llvm
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.typed_passes import NopythonTypeInference

ENVIRONMENT = "_ZN08NumbaEnv"  # beginning of the names of numba's environments, whose addresses it asks for


class InnerLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Code of a function that is linked into its callers, without machine code of its own."""

    def _optimize_final_module(self) -> None:
        """Leave that to the callers."""

    def _finalize_final_module(self) -> None:
        """Add no more than the environments to the engine."""
        self._finalize_dynamic_globals()
        names = [v.name for v in self._final_module.global_variables if v.name.startswith(ENVIRONMENT)]
        text = str(self._codegen._create_empty_module(f"{self.name}.environments"))
        text += "".join(f'@"{name}" = common global ptr null\n' for name in names)
        self._codegen._add_module(llvm.parse_assembly(text))
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return what Python calls: a function of its own that raises TypeError, whatever its arguments."""
        del name
        self._ensure_finalized()
        return int(ctypes.cast(ctypes.pythonapi.PyErr_BadArgument, ctypes.c_void_p).value or 0)


@register_pass(mutates_CFG=False, analysis_only=True)
class ChooseInnerLibrary(FunctionPass):  # type: ignore[misc]
    """Lets the code of a function be made in an :class:`InnerLibrary`."""

    _name = "apex_ompl_choose_inner_library"

    def __init__(self) -> None:
        """Make the pass."""
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        """Set the library; the function is not changed."""
        state.library = InnerLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        return False


class InnerCompiler(CompilerBase):  # type: ignore[misc]
    """Compiler of functions that only compiled ones call."""

    def define_pipelines(self) -> list[Any]:
        """Return numba's passes, and the choice of the library among them."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(ChooseInnerLibrary, NopythonTypeInference)
        passes.finalize()
        return [passes]
