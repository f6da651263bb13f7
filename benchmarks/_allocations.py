"""How often memory is asked for: malloc and its like, counted in a process of its own by a library loaded before."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

SOURCE = """
#include <errno.h>
#include <stddef.h>
void *__libc_malloc(size_t), *__libc_calloc(size_t, size_t), *__libc_realloc(void *, size_t);
void *__libc_memalign(size_t, size_t);
static _Atomic long made;
long allocations(void) { return made; }
void *malloc(size_t size) { return ++made, __libc_malloc(size); }
void *calloc(size_t count, size_t size) { return ++made, __libc_calloc(count, size); }
void *realloc(void *old, size_t size) { return ++made, __libc_realloc(old, size); }
void *memalign(size_t align, size_t size) { return ++made, __libc_memalign(align, size); }
void *aligned_alloc(size_t align, size_t size) { return ++made, __libc_memalign(align, size); }
int posix_memalign(void **result, size_t align, size_t size) {
    ++made;
    *result = __libc_memalign(align, size);
    return *result ? 0 : ENOMEM;
}
"""


def run_counting(arguments: Sequence[str]) -> str:
    """What this Python prints with these arguments, `counted` at its service; empty without glibc and a C compiler."""
    compiler = shutil.which("cc")
    if compiler is None or not hasattr(ctypes.CDLL(None), "__libc_malloc"):
        return ""
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "count.c", Path(folder) / "count.so"
        source.write_text(SOURCE, encoding="utf-8")
        subprocess.run([compiler, "-O1", "-fPIC", "-shared", "-o", str(library), str(source)], check=True)
        environment = {**os.environ, "LD_PRELOAD": str(library)}
        return subprocess.run(
            [sys.executable, *arguments], env=environment, stdout=subprocess.PIPE, text=True, check=True
        ).stdout


def counted(call: Callable[[], object]) -> int:
    """How often a call asks for memory, in a process of `run_counting`."""
    made = ctypes.CDLL(None).allocations
    made.restype = ctypes.c_long
    before = made()
    call()
    return int(made() - before)
