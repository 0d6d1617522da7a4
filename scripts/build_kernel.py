"""Build the library of the kernel's compiled functions from the code that numba makes of them.

Each function is compiled as numba does when Python calls it, for a processor of a level instead of this one, emitted as
an object file, and linked with ``apex_ompl/kernel/library/kernel.c`` into ``apex_ompl/kernel/library/kernel-*.elf``;
a description beside it says from which sources and by which versions. Needs gcc, for another architecture its cross
compiler (Debian: gcc-aarch64-linux-gnu).

Usage: python scripts/build_kernel.py [--machine x86_64] [--check] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import struct
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.errors import ApexError
from apex_ompl.kernel import library
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.process import usable_cores

VERSIONS = "numba", "llvmlite"


class BuildError(ApexError):
    """The library cannot be built, or differs from the one in the package."""


@dataclass(frozen=True)
class Machine:
    """An architecture.

    Attributes:
        triple: Its name for LLVM.
        processor: The processor, or level of processors, that code is made for.
        compiler: C compiler.
        supported: C expression for whether a processor runs the code.
    """

    triple: str
    processor: str
    compiler: str
    supported: str


MACHINES = {
    "x86_64": Machine("x86_64-unknown-linux-gnu", "x86-64-v3", "gcc", '!!__builtin_cpu_supports("x86-64-v3")'),
    "aarch64": Machine("aarch64-unknown-linux-gnu", "cortex-a72", "aarch64-linux-gnu-gcc", "1"),
}


@dataclass(frozen=True)
class Built:
    """A compiled function.

    Attributes:
        name: Module and name.
        arguments: Kinds of its arguments, see ``kernel.c``.
        result: Kinds of its result.
        slots: How many slots its arguments take.
        code: The object file.
    """

    name: str
    arguments: str
    result: str
    slots: int
    code: bytes

    @property
    def function(self) -> str:
        """Its name in C."""
        return self.name.replace(".", "_")

    @property
    def digest(self) -> str:
        """Digest of instructions and constants."""
        digest = hashlib.sha256()
        for part in code_sections(self.code):
            digest.update(part)
        return digest.hexdigest()


def code_sections(code: bytes) -> Iterator[bytes]:
    """Yield instructions and constants of a 64-bit ELF file, see the System V ABI, chapter 4."""
    (table,) = struct.unpack_from("<Q", code, 40)
    size, count, names = struct.unpack_from("<HHH", code, 58)
    sections = [struct.unpack_from("<IIQQQQ", code, table + k * size) for k in range(count)]
    for name, _, _, _, start, length in sections:
        label = code[sections[names][4] + name :].partition(b"\0")[0]
        if label.startswith((b".text", b".rodata.cst")):
            yield code[start : start + length]


def main() -> None:
    """Build, or compare what is built with what is in the package."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machine", choices=MACHINES, default="x86_64", help="architecture (default: x86_64)")
    parser.add_argument("--check", action="store_true", help="build anew and compare with the library in the package")
    parser.add_argument("--out", type=Path, default=library.FOLDER, help="folder to write to (default: the package)")
    args = parser.parse_args()
    machine = MACHINES[args.machine]
    with tempfile.TemporaryDirectory() as folder:
        built = compile_all(args.machine)
        code = {one.name: one.digest for one in built}
        if args.check:
            check(code, library.library_file(args.machine))
            print(f"{len(code)} functions have the code of the library in the package")
            return
        file = args.out / library.library_file(args.machine).name
        temporary = Path(folder) / file.name
        link(built, machine, Path(folder), temporary)
        description = {
            "sources": library.sources_digest(),
            "library": hashlib.sha256(temporary.read_bytes()).hexdigest(),
            "processor": machine.processor,
            "versions": {name: version(name) for name in VERSIONS},
            "code": code,
        }
        args.out.mkdir(parents=True, exist_ok=True)
        write_atomically(file, temporary.read_bytes())  # this process, and others, may have loaded the one before
        file.with_suffix(".json").write_text(json.dumps(description, indent=1) + "\n")
        print(f"{file}: {len(built)} functions, {file.stat().st_size / 2**20:.2f} MiB")


def check(code: dict[str, str], file: Path) -> None:
    """Raise BuildError where the library in the package is of other sources, or has other code."""
    try:
        description = json.loads(file.with_suffix(".json").read_text())
    except OSError as error:
        raise BuildError(f"{error.filename} cannot be read: run scripts/build_kernel.py") from None
    if description["sources"] != library.sources_digest():
        raise BuildError(f"{file.name} was built from other sources: run scripts/build_kernel.py")
    if hashlib.sha256(file.read_bytes()).hexdigest() != description["library"]:
        raise BuildError(f"{file.name} is not the file that {file.stem}.json describes: run scripts/build_kernel.py")
    there, now = description["code"], {name: version(name) for name in VERSIONS}
    if now != description["versions"]:
        raise BuildError(f"{file.name} was built by {description['versions']}, and {now} cannot be compared with these")
    if other := sorted(name for name in code | there if code.get(name) != there.get(name)):
        raise BuildError(f"{file.name} has other code of {', '.join(other)}: run scripts/build_kernel.py")


def compile_all(machine: str) -> list[Built]:
    """Compile all functions, those that call the same ones in one process."""
    from apex_ompl.kernel.compiled.entry_points import CONSTRAINED, OTHERS, PLANS, RUNS

    parts = [list(part) for group in (PLANS, RUNS, CONSTRAINED) for part in group.parts] + [list(OTHERS)]
    os.environ[library.CHOICE] = "numba"
    with ProcessPoolExecutor(len(usable_cores()), get_context("spawn")) as pool:
        tasks = [pool.submit(compile_some, machine, part) for part in parts]
        found = [one for task in tasks for one in task.result()]
    return sorted(found, key=lambda one: one.name)


def compile_some(machine: str, names: Sequence[str]) -> list[Built]:
    """Compile some functions, in a process that compiles nothing else."""
    return [compile_one(MACHINES[machine], name) for name in names]


def compile_one(machine: Machine, name: str) -> Built:
    """Compile a function for an architecture."""
    from llvmlite import binding as llvm
    from numba.core.caching import NullCache

    from apex_ompl.kernel.compiled.entry_points import ALL
    from apex_ompl.kernel.compiled.linking import ForeignCompiler

    module, _, function = name.rpartition(".")
    compiled = getattr(import_module(f"{library.PACKAGE}.{module}"), function)
    compiled.dispatcher._cache = NullCache()  # code from a cache has no module to emit
    compiled.dispatcher._compiler.pipeline_class = ForeignCompiler
    compiled.compile(ALL[name][0])
    (found,) = compiled.dispatcher.overloads.values()
    for of in (llvm.initialize_all_targets, llvm.initialize_all_asmprinters):
        of()
    target = llvm.Target.from_triple(machine.triple).create_target_machine(
        cpu=machine.processor, opt=3, reloc="pic", codemodel="default"
    )
    code = found.library.optimized_for(target, machine.triple)
    arguments = "".join(kinds(one) for one in found.signature.args)
    slots = with_uniform_entry(code, found.fndesc.llvm_func_name, name.replace(".", "_"))
    builder = llvm.create_pass_builder(target, llvm.create_pipeline_tuning_options(speed_level=0))
    unneeded = llvm.create_new_module_pass_manager()
    unneeded.add_global_dead_code_eliminate_pass()
    unneeded.run(code, builder)
    return Built(name, arguments, kinds(found.signature.return_type), slots, target.emit_object(code))


def kinds(of: Any) -> str:
    """Return the kinds that ``kernel.c`` has for a type of numba's."""
    from numba.core import types

    of = types.unliteral(of)
    if isinstance(of, types.Array) and of.layout == "C" and of.mutable:
        return {"int64": "q", "float64": "d", "float32": "f", "int8": "b"}[str(of.dtype)] + str(of.ndim)
    if isinstance(of, types.BaseTuple):
        return f"({''.join(kinds(one) for one in of)})"
    return {types.int64: "I", types.float64: "D", types.boolean: "B", types.none: "-"}[of]


def with_uniform_entry(code: Any, native: str, name: str) -> int:
    """Add ``code_NAME(slots)`` to a module, which calls a function; return how many slots it reads.

    All other functions are dropped where that one does not call them.
    """
    from llvmlite import binding as llvm

    for function in code.functions:
        if not function.is_declaration:
            function.linkage = "internal"
    entry = code.get_function(native)
    types = [str(argument.type) for argument in entry.arguments]
    lines = [f'declare i32 @"{native}"({", ".join(types)})', f"define i32 @code_{name}(ptr %slots) {{"]
    for k, of in enumerate(types):
        lines += [f"%p{k} = getelementptr i64, ptr %slots, i64 {k}", f"%a{k} = load {of}, ptr %p{k}"]
    given = ", ".join(f"{of} %a{k}" for k, of in enumerate(types))
    lines += [f'%r = call i32 @"{native}"({given})', "ret i32 %r", "}"]
    entry.linkage = "external"  # else it is not the one that is linked
    wrapper = llvm.parse_assembly("\n".join(lines))
    wrapper.triple, wrapper.data_layout = code.triple, code.data_layout
    code.link_in(wrapper)
    code.get_function(native).linkage = "internal"
    return len(types)


def link(built: Sequence[Built], machine: Machine, folder: Path, out: Path) -> None:
    """Link functions into a library."""
    entries = (f'ENTRY({one.function}, "{one.name}", "{one.arguments}", "{one.result}")\n' for one in built)
    (folder / "entries.h").write_text("".join(entries))
    (folder / "settings.h").write_text(
        f"#define SLOTS {max(one.slots for one in built)}\n#define SUPPORTED {machine.supported}\n"
    )
    (folder / "exports").write_text("{ global: PyInit__kernel; local: *; };\n")
    objects = []
    for one in built:
        objects.append(folder / f"{one.function}.o")
        objects[-1].write_bytes(one.code)
    includes = [folder, sysconfig.get_paths()["include"], np.get_include()]
    flags = ["-O2", "-fPIC", "-Wall", "-Wextra", "-Werror", *(f"-I{path}" for path in includes)]
    front = folder / "front.o"
    run([machine.compiler, *flags, "-c", library.FOLDER / "kernel.c", "-o", front])
    options = [f"--version-script={folder / 'exports'}", "-z,now", "-z,noexecstack", "--build-id=none", "-s"]
    run([machine.compiler, "-shared", *(f"-Wl,{one}" for one in options), front, *objects, "-lm", "-o", out])
    if unknown := sorted(unresolved(out)):
        raise BuildError(f"the code calls {', '.join(unknown)}, which neither kernel.c nor the C library has")
    if sys.prefix.encode() in out.read_bytes():
        raise BuildError(f"the code names files in {sys.prefix}: a function of numba's may raise an error there")


def unresolved(file: Path) -> Iterator[str]:
    """Yield the names of functions of numba's runtime that a library asks for: nothing would resolve them."""
    done = subprocess.run(["nm", "-D", "--undefined-only", file], check=True, capture_output=True, text=True)
    for name in re.findall(r"\bU (\S+)", done.stdout):
        if "@" not in name and not name.lstrip("_").startswith("Py"):
            yield name


def run(command: Sequence[str | Path]) -> None:
    """Run a command; raise BuildError with what it printed where it fails."""
    try:
        done = subprocess.run(command, check=False, capture_output=True, text=True)
    except OSError as error:
        raise BuildError(f"{command[0]} cannot be run ({error.strerror})") from None
    if done.returncode:
        raise BuildError(f"{command[0]} failed: {done.stderr.strip()}")


if __name__ == "__main__":
    sys.exit(run_script(main))
