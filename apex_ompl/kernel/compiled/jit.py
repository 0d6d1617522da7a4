"""Compilation of the kernel by numba, where the library that comes with the package is not used; cached on disk.

numba renews cached code when the one file that it was written in changes. The functions of this folder are compiled
into each other and import nothing else, so their cache is a folder named after a digest of all its files, of the
versions of Python and numba, of Python's level of optimization, which changes what is compiled, and of the processor:
installations of the same files share it, wherever they lie. It is in ``$NUMBA_CACHE_DIR`` when that is set, or in the
user's cache folder. One that cannot be written is read all the same, and files in it that are damaged are made anew.
What cannot be kept is compiled in every process; a warning says so. ``$NUMBA_DISABLE_JIT`` is for other code: this one,
as Python, would take minutes for a path.

All processors of level x86-64-v3 get the same code, which is that of the library, and so the same results, bit for bit.
"""

from __future__ import annotations

import gc
import hashlib
import logging
import os
import platform
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, cached_property, partial, update_wrapper
from pathlib import Path
from typing import Any

import numba
from llvmlite import binding as llvm
from numba.core.caching import CompileResultCacheImpl, FunctionCache, InTreeCacheLocator
from numba.core.codegen import JITCPUCodegen
from numba.core.compiler import Compiler
from numba.core.cpu import CPUContext
from numba.core.registry import CPUDispatcher, CPUTarget
from numba.core.sigutils import normalize_signature
from numba.core.target_extension import CPU, dispatcher_registry, jit_registry, target_registry

from apex_ompl.kernel.compiled.linking import InnerCompiler
from apex_ompl.kernel.library import why_not_used
from apex_ompl.util.cache import has_room, user_cache
from apex_ompl.util.forking import hold_at_fork

LOG = logging.getLogger("apex_ompl")

# Without numba's runtime (_nrt) references to arrays are not counted, which would take most of the time; in return
# compiled code may allocate nothing.
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False, "no_cfunc_wrapper": True}

# Functions that only compiled ones call need no code that unpacks Python's arguments, which takes long to compile. What
# is not set here numba takes from the function that is being compiled when it comes to this one.
INNER: dict[str, Any] = {**OPTIONS, "no_cpython_wrapper": True, "pipeline_class": InnerCompiler, "fastmath": False}
REASSOCIATING = {"reassoc", "contract"}

LEVEL = "x86-64-v3"
FEATURES = "avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"
"""Processors of a level have these, by LLVM's names; see the ABI of x86-64, table 3.1."""

ROOM = 8 * 2**20  # in the cache, which the code of some functions fills [bytes]

lock = threading.RLock()
hold_at_fork(lock)


@cache
def _has_level() -> bool:
    if platform.machine() != "x86_64":
        return False
    features = llvm.get_host_cpu_features()
    return all(features.get(name) for name in FEATURES)


@cache
def _digest() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    processor = f"{platform.machine()} {LEVEL if _has_level() else llvm.get_host_cpu_name()}"
    digest.update(f"{sys.version_info[:3]} {sys.flags.optimize} {numba.__version__} {processor}".encode())
    return digest.hexdigest()[:16]


@cache
def cache_folder() -> Path | None:
    """Return the folder that compiled code is read from and kept in, or None when no place for it can be written."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    return user_cache(f"kernel-{_digest()}", (given,) if given else (), or_filled=True)


@cache
def can_keep_code() -> bool:
    """Whether compiled code can be kept: the cache can be written, and there is room."""
    folder = cache_folder()
    return folder is not None and has_room(folder, ROOM)


def whereabouts() -> str:
    """Return where compiled code is kept, in words for the log."""
    folder = cache_folder()
    if folder is not None and can_keep_code():
        return f"kept in {folder}"
    why = "no cache folder can be written" if folder is None else f"{folder} cannot be written, or is full"
    return f"in every process anew, since {why}"


def names_in_cache() -> set[str]:
    """Return the names of the functions whose code is in the cache."""
    folder = cache_folder()
    code = folder.rglob("*.nbc") if folder else ()
    return {path.name.split(".")[1].rsplit("-", 1)[0] for path in code}


class _Codegen(JITCPUCodegen):  # type: ignore[misc]
    """Makes code for any processor of level x86-64-v3 where this one is of it, as the library has it: the same bits."""

    def _get_host_cpu_name(self) -> str:
        return LEVEL if _has_level() else str(super()._get_host_cpu_name())

    def _get_host_cpu_features(self) -> str:
        return "" if _has_level() else str(super()._get_host_cpu_features())


class _Context(CPUContext):  # type: ignore[misc]
    """Numba's context of the processor, with code of its own kind."""

    def init(self) -> None:
        super().init()
        self._internal_codegen = _Codegen("apex_ompl")


class _Target(CPUTarget):  # type: ignore[misc]
    """What numba compiles the kernel for."""

    @cached_property
    def _toplevel_target_context(self) -> Any:
        return _Context(self.typing_context, self._target_name)


TARGET = _Target("apex_ompl")


class _Dispatcher(CPUDispatcher):  # type: ignore[misc]
    """Numba's function of the kernel."""

    targetdescr = TARGET


class _Processor(CPU):  # type: ignore[misc]
    """The target by numba's registries, so that what numba itself has compiled for it is of the same kind."""


target_registry[TARGET._target_name] = _Processor
dispatcher_registry[_Processor] = _Dispatcher
jit_registry[_Processor] = lambda **options: partial(_dispatcher, **options)


def _dispatcher(function: Callable[..., Any], *, pipeline_class: Any = None, **options: Any) -> Any:
    """Return a function that numba compiles when it is called, whether or not the user has disabled that elsewhere."""
    options = {"nopython": True, "boundscheck": None} | options
    return _Dispatcher(function, {}, options, pipeline_class or Compiler)


def type_of(function: Any) -> Any:
    """Return numba's type of a function of numba's: what a decorator of this module or numba's ``intrinsic`` made."""
    if (known := getattr(function, "_numba_type_", None)) is not None:
        return known
    context = TARGET.typing_context
    context.refresh()
    return context.resolve_value_type(function)


def inner(function: Callable[..., Any], *, reassociating: bool = False, **options: Any) -> Any:
    """Return a function that only other compiled ones call, as numba knows it."""
    return _dispatcher(function, **INNER | {"fastmath": REASSOCIATING if reassociating else False}, **options)


def uncached(function: Callable[..., Any]) -> Any:
    """Return a function that Python calls, compiled in every process anew, for experiments and tests."""
    return _dispatcher(function, **OPTIONS)


class _Locator(InTreeCacheLocator):  # type: ignore[misc]
    """Where numba keeps code: in one folder, independent of place and date of the file that defines a function."""

    def ensure_cache_path(self) -> None:
        """It is there, and may be read-only."""

    def get_cache_path(self) -> str:
        return str(cache_folder())

    def get_source_stamp(self) -> str:
        return hashlib.sha256(Path(self._py_file).read_bytes()).hexdigest()


class _CacheFiles(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = (_Locator,)


class _Cache(FunctionCache):  # type: ignore[misc]
    """The cache of a function, whose faults are no errors: the function is compiled."""

    _impl_class = _CacheFiles

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # pickle raises many kinds on a file that is empty or cut off
            where = f"the file of its code in {cache_folder()} is damaged"
            LOG.warning("apex_ompl compiles %s: %s (%s)", self._py_func.__name__, where, error)
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except Exception as error:  # the disk is full, or what is there is damaged
            LOG.info("apex_ompl cannot keep the code of %s: %s", self._py_func.__name__, error)


@contextmanager
def _rare_collections() -> Iterator[None]:
    """Look for garbage less often during a block: a tenth of numba's time goes there, and it keeps what it makes."""
    before = gc.get_threshold()
    if before[0]:  # else there are none
        gc.set_threshold(max(before[0], 100_000), *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


class CompiledFunction:
    """A compiled function whose first call warns that it compiles, unless an earlier process left its code.

    Attributes:
        name: Its name.
        dispatcher: numba's dispatcher.
    """

    _announced = False

    def __init__(self, function: Callable[..., Any], *, reassociating: bool = False) -> None:
        """Let numba compile a function when it is called."""
        options = {"fastmath": REASSOCIATING} if reassociating else {}
        self.dispatcher: Any = _dispatcher(function, **OPTIONS, **options)
        if cache_folder() is not None:
            self.dispatcher._cache = _Cache(function)
        self.name = function.__name__
        update_wrapper(self, function)
        self._ready = False

    @property
    def is_cached(self) -> bool:
        """Whether there is code of it in the cache."""
        return self.name in names_in_cache()

    def compile(self, types: str) -> None:
        """Compile the function into the cache for arguments of the given types, without a warning."""
        with lock, _rare_collections():
            self.dispatcher.compile(normalize_signature(f"({types},)")[0])  # the cache takes a text for another key
            self._ready = True

    def __call__(self, *arguments: Any) -> Any:
        """Call the function, compiled for the types of the arguments."""
        if self._ready:
            return self.dispatcher(*arguments)
        with lock:
            if self.is_cached:
                result = self.dispatcher(*arguments)
            else:
                self._announce()
                start = time.perf_counter()
                with _rare_collections():
                    result = self.dispatcher(*arguments)
                LOG.warning("apex_ompl compiled %s in %.1f s", self.name, time.perf_counter() - start)
            self._ready = True
        return result

    @staticmethod
    def _announce() -> None:
        if CompiledFunction._announced:
            return
        CompiledFunction._announced = True
        why = why_not_used()
        LOG.warning("apex_ompl compiles functions of its collision kernel (%s), since %s", whereabouts(), why)
