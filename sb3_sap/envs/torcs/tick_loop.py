"""Many ticks of TORCS' physics in one call.

A call from Python costs about a third of what a tick of the physics does. There need not be a compiler, so the loop
around the ticks is 54 bytes of machine code; where a system forbids that, Python does the same loop.
"""

from __future__ import annotations

import ctypes
import mmap
from collections.abc import Callable
from functools import cache
from typing import Any

#: void loop(void *situation, long ticks, void (*update)(void *, double, int), double tick), for amd64 under System V.
CODE = bytes.fromhex(
    "53"  # push rbx
    "4154"  # push r12
    "4155"  # push r13
    "4883ec10"  # sub rsp, 16            the stack is aligned again
    "4889fb"  # mov rbx, rdi             situation
    "4989f4"  # mov r12, rsi             ticks
    "4989d5"  # mov r13, rdx             update
    "f20f110424"  # movsd [rsp], xmm0    tick
    "4889df"  # again: mov rdi, rbx
    "f20f100424"  # movsd xmm0, [rsp]
    "beffffffff"  # mov esi, -1          no telemetry
    "41ffd5"  # call r13
    "49ffcc"  # dec r12
    "75eb"  # jnz again
    "4883c410"  # add rsp, 16
    "415d"  # pop r13
    "415c"  # pop r12
    "5b"  # pop rbx
    "c3"  # ret
)
#: Bytes of the memory that holds it: one page.
PAGE = 4096

Loop = Callable[[int], None]


def tick_loop(update: Any, situation: int, tick: float, native: bool = True) -> Loop:
    """A function of a number of ticks, at least 1, that advances the physics by them.

    :param update: TORCS' SimUpdate, as ctypes loaded it
    :param situation: address of the situation
    :param tick: s
    :param native: False: loop in Python
    """
    machine = _machine_code() if native else None
    if machine is None:

        def python_loop(ticks: int) -> None:
            for _ in range(ticks):
                update(situation, tick, -1)

        return python_loop
    # Converted once: converting the arguments takes as long as the call.
    address = ctypes.c_void_p(ctypes.cast(update, ctypes.c_void_p).value)
    pointer, seconds = ctypes.c_void_p(situation), ctypes.c_double(tick)
    counts: dict[int, ctypes.c_long] = {}

    def native_loop(ticks: int) -> None:
        count = counts.get(ticks)
        if count is None:
            count = counts[ticks] = ctypes.c_long(ticks)
        machine(pointer, count, address, seconds)

    return native_loop


@cache
def _machine_code() -> Any:
    try:
        page = mmap.mmap(-1, PAGE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    except OSError:  # memory that can be written and executed is forbidden
        return None
    page.write(CODE)
    kind = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_long, ctypes.c_void_p, ctypes.c_double)
    function = kind(ctypes.addressof(ctypes.c_char.from_buffer(page)))
    function.page = page  # type: ignore[attr-defined]  # which lives as long as the function
    return function
