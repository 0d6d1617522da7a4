"""How numba compiles functions that only other compiled ones call: their code is linked into that of their callers.

By itself numba optimizes every function together with all that it calls, and makes machine code of it; a function that
is called through five others is optimized six times. Here functions that Python never calls are left as they are
lowered, and each function that Python calls is optimized once, with all that was linked into it.
"""

from __future__ import annotations

import ctypes
from types import SimpleNamespace
from typing import Any

from llvmlite import binding as llvm
from numba.core.codegen import CPUCodeLibrary, JITCodeLibrary, JITCPUCodegen
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.typed_passes import NopythonTypeInference

ENVIRONMENT = "_ZN08NumbaEnv"  # prefix of the names of numba's environments, whose addresses it asks for


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
        """Return what Python calls: a function that raises TypeError for any arguments."""
        del name
        self._ensure_finalized()
        return int(ctypes.cast(ctypes.pythonapi.PyErr_BadArgument, ctypes.c_void_p).value or 0)


class ForeignLibrary(InnerLibrary):
    """Code of a function that Python calls, for other processors: it can be optimized for them, and not called."""

    def optimized_for(self, target: Any, triple: str) -> Any:
        """Return the module of the code with all that it calls, optimized as numba does for a target machine."""
        self._ensure_finalized()
        module = self._final_module.clone()
        module.triple, module.data_layout = triple, str(target.target_data)
        codegen = JITCPUCodegen.__new__(JITCPUCodegen)
        codegen.__dict__ |= {
            "_tm": target,
            "_loopvect": self._codegen._loopvect,
            "_opt_level": self._codegen._opt_level,
        }
        found = SimpleNamespace(_final_module=module, _codegen=codegen, _recorded_timings=self._recorded_timings)
        CPUCodeLibrary._optimize_final_module(found)
        return found._final_module


class _ChooseLibrary(FunctionPass):  # type: ignore[misc]
    """Lets the code of a function be made in a library of another kind than numba's."""

    _kind: type[JITCodeLibrary]

    def __init__(self) -> None:
        """Make the pass."""
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        """Set the library; the function is not changed."""
        state.library = self._kind(state.targetctx.codegen(), state.func_id.func_qualname)
        return False


@register_pass(mutates_CFG=False, analysis_only=True)
class ChooseInnerLibrary(_ChooseLibrary):
    """Lets the code of a function be made in an :class:`InnerLibrary`."""

    _name, _kind = "apex_ompl_choose_inner_library", InnerLibrary


@register_pass(mutates_CFG=False, analysis_only=True)
class ChooseForeignLibrary(_ChooseLibrary):
    """Lets the code of a function be made in a :class:`ForeignLibrary`."""

    _name, _kind = "apex_ompl_choose_foreign_library", ForeignLibrary


class InnerCompiler(CompilerBase):  # type: ignore[misc]
    """Compiler of functions that only compiled ones call."""

    _choice: type[_ChooseLibrary] = ChooseInnerLibrary

    def define_pipelines(self) -> list[Any]:
        """Return numba's passes, and the choice of the library among them."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(self._choice, NopythonTypeInference)
        passes.finalize()
        return [passes]


class ForeignCompiler(InnerCompiler):
    """Compiler of functions that Python calls, whose code is wanted for other processors than this one."""

    _choice = ChooseForeignLibrary
