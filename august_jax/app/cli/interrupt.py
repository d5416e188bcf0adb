"""Ctrl-C ends the command at once, whatever it is doing.

Python looks at an interrupt between two of its own steps. A command may be within the compiler for half a minute, which
then hears nothing, or, where an interrupt unwinds a program that the compiler's threads still work for, ends it by a
fault. Here the system's handler wakes a thread, which removes what is aside and ends the process: as after a kill, all
files are whole (:mod:`august_jax.files`).
"""

from __future__ import annotations

import os
import signal
import threading

from august_jax.app.cli.messages import note

TOLD = "august: interrupted; finished files are kept, nothing is half-written"
STATUS = 130
"""The exit status, by the shells' custom."""


def end_at_once() -> None:
    """From now on an interrupt ends this process with :data:`STATUS`; where interrupts are ignored, they stay so."""
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    # the system's handler writes into the pipe only where Python has one of its own to call later
    signal.signal(signal.SIGINT, lambda *_: None)
    threading.Thread(target=_watch, args=(reading,), daemon=True, name="interrupt").start()


def _watch(reading: int) -> None:
    while signal.SIGINT not in os.read(reading, 1):
        pass
    try:
        note(TOLD)
        from august_jax.files import discard_unfinished

        discard_unfinished()
    finally:
        os._exit(STATUS)
