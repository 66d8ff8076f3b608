"""Loading TORCS' libraries, and a private copy of the simulator and the track builder for each simulation."""

from __future__ import annotations

import ctypes
import locale
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from sb3_sap.envs.torcs.installation import MODULES, SHARED, Installation
from sb3_sap.envs.torcs.structures import LocalPosition

_Position = ctypes.POINTER(LocalPosition)
_Float = ctypes.POINTER(ctypes.c_float)
#: Mode of GfParmReadFile: read the file as it is.
READ_STANDARD = 1
#: Mode of GfParmMergeHandles: merge sections and parameters of both handles, and release them.
MERGE_ALL = 15


#: Locks of TORCS' parser and of the pool's creation.
_reading = threading.RLock()
_making = threading.Lock()


@contextmanager
def reading() -> Iterator[None]:
    """Lets one thread at a time into TORCS' parser, which is global, and gives it the decimal point it expects.

    TORCS reads numbers with strtod: in a locale with a decimal comma "0.5" would silently be 0.
    """
    with _reading:
        before = locale.setlocale(locale.LC_NUMERIC)
        locale.setlocale(locale.LC_NUMERIC, "C")
        try:
            yield
        finally:
            locale.setlocale(locale.LC_NUMERIC, before)


class Shared:
    """The functions of the libraries that every simulation of a process shares."""

    def __init__(self, root: Path):
        loaded = [ctypes.CDLL(str(root / path), mode=ctypes.RTLD_GLOBAL | os.RTLD_LAZY) for path in SHARED]
        _, tgf, tools, *_ = loaded
        string, pointer = ctypes.c_char_p, ctypes.c_void_p
        self.read_parameters = _function(tgf, "_Z14GfParmReadFilePKci", pointer, string, ctypes.c_int)
        self.merge = _function(tgf, "_Z18GfParmMergeHandlesPvS_i", pointer, pointer, pointer, ctypes.c_int)
        self.release_parameters = _function(tgf, "_Z19GfParmReleaseHandlePv", None, pointer)
        self.to_global = _function(
            tools, "_Z19RtTrackLocal2GlobalP10tTrkLocPosPfS1_i", None, _Position, _Float, _Float, ctypes.c_int
        )
        self.height = _function(tools, "_Z14RtTrackHeightLP10tTrkLocPos", ctypes.c_float, _Position)
        self.heading = _function(tools, "_Z19RtTrackSideTgAngleLP10tTrkLocPos", ctypes.c_float, _Position)
        _function(tgf, "_Z10GfParmInitv", None)()


class Private:
    """A private copy of the two libraries, whose simulator and track are global variables."""

    def __init__(self, root: Path):
        pointer = ctypes.c_void_p
        with tempfile.TemporaryDirectory(prefix="sb3-sap-torcs-") as folder:
            # Another path is another library to the loader; the file may go once it is mapped.
            simu, track = (
                ctypes.CDLL(shutil.copy(root / path, folder), mode=os.RTLD_LOCAL | os.RTLD_LAZY)
                for path in MODULES.values()
            )
        self.init = _function(
            simu, "_Z7SimInitiP6tTrackff", None, ctypes.c_int, pointer, ctypes.c_float, ctypes.c_float
        )
        self.configure = _function(simu, "_Z9SimConfigP6CarEltP6RmInfo", None, pointer, pointer)
        self.update = _function(simu, "_Z9SimUpdateP9Situationdi", None, pointer, ctypes.c_double, ctypes.c_int)
        self.shutdown = _function(simu, "_Z11SimShutdownv", None)
        self.build_track = _function(track, "_Z12TrackBuildv1Pc", pointer, ctypes.c_char_p)
        self.close_track = _function(track, "_Z13TrackShutdownv", None)


class LibraryPool:
    """Hands out private copies and takes them back, so that many environments, one after the other, need only one."""

    def __init__(self, installation: Installation):
        self.root = installation.root
        self.shared = Shared(self.root)
        self._free: list[Private] = []
        self._lock = threading.Lock()

    def acquire(self) -> Private:
        """A copy that nobody else uses."""
        with self._lock:
            return self._free.pop() if self._free else Private(self.root)

    def release(self, library: Private) -> None:
        """Returns a copy whose simulator and track have been shut down."""
        with self._lock:
            self._free.append(library)


def pool(installation: Installation) -> LibraryPool:
    """The pool of this process."""
    with _making:  # two threads would initialise the shared libraries twice
        return _pool(installation)


@cache
def _pool(installation: Installation) -> LibraryPool:
    return LibraryPool(installation)


def _function(library: ctypes.CDLL, symbol: str, result: Any, *arguments: Any) -> Any:
    function = library[symbol]
    function.restype, function.argtypes = result, list(arguments)
    return function
