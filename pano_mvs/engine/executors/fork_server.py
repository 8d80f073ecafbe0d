"""A process that has loaded what workers need and forks them, so that importing costs its time once.

A worker needs 2 to 3 CPU-s to load the stages and the libraries that nearly all of them use. On Linux, all workers of
an executor are forked by one process that has done so and runs nothing else; it has one thread, without which a fork
would not be safe. Elsewhere, or if a plugin starts threads when it is imported, each worker is started by itself.

The main process asks over a socket for each worker and passes its standard streams. The server answers with the process
id, and later with the exit status. It adopts what a worker leaves behind, and ends that before it reports the status.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import queue
import selectors
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from pano_mvs.core.paths import children
from pano_mvs.engine.executors import worker
from pano_mvs.engine.executors.threads import bound_environment

_BOOT = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from pano_mvs.engine.executors.fork_server import serve; "
    "serve(int(sys.argv[2]))"
)
_PRELOADED = "numba", "scipy.ndimage", "scipy.sparse.csgraph", "scipy.spatial"  # which most units use
_START_S = 600.0  # slow disks and many plugins included
_MESSAGE_BYTES = 4096


class ForkedProcess:
    """A forked worker, as far as it is used like a `subprocess.Popen`; `returncode` is None until it has ended."""

    def __init__(self, pid: int, stdin: BinaryIO, stdout: BinaryIO) -> None:
        self.pid = pid
        self.stdin: BinaryIO | None = stdin
        self.stdout: BinaryIO | None = stdout
        self.returncode: int | None = None
        self._ended = threading.Event()

    def kill(self) -> None:
        """End it at once."""
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)

    def poll(self) -> int | None:
        """Return the exit status, negative for a signal; None while it runs."""
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end, and return the exit status.

        Raises:
            subprocess.TimeoutExpired: if it runs longer.
        """
        if not self._ended.wait(timeout) or self.returncode is None:
            raise subprocess.TimeoutExpired("worker", timeout or 0.0)
        return self.returncode

    def note_end(self, returncode: int) -> None:
        """Note that it has ended."""
        self.returncode = returncode
        self._ended.set()


class ForkServer:
    """Forks workers; it is started for the first one.

    Args:
        threads: the most threads that a worker may use.
    """

    available = sys.platform == "linux"

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._asking = threading.Lock()  # workers are started by several threads
        self._socket: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._pids: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._running: dict[int, ForkedProcess] = {}
        self._ended_early: dict[int, int] = {}
        self._state = threading.Lock()
        self._works = self.available

    def fork(self, mark: str, errors: Path) -> ForkedProcess | None:
        """Return a new worker; None if none can be forked, so that it is to be started by itself.

        Args:
            mark: value of `worker.MARK` in its environment.
            errors: file for what it prints outside units.

        Raises:
            OSError: if there are no pipes or files left.
        """
        with self._asking:
            if self._works and self._socket is None:
                self._start()
            if not self._works or self._socket is None:
                return None
            with errors.open("wb") as said, _pipes() as ((stdin, to_worker), (from_worker, stdout)):
                try:
                    message = json.dumps({"mark": mark}).encode()
                    socket.send_fds(self._socket, [message], [stdin, stdout, said.fileno()])
                    pid = self._pids.get(timeout=_START_S)
                except (OSError, queue.Empty):
                    pid = 0
                if not pid:
                    self._works = False
                    return None
                to_worker, from_worker = os.dup(to_worker), os.dup(from_worker)
            forked = ForkedProcess(pid, os.fdopen(to_worker, "wb"), os.fdopen(from_worker, "rb"))
            with self._state:
                self._running[pid] = forked
                early = self._ended_early.pop(pid, None)
            if early is not None:
                self._end(pid, early)
            return forked

    def close(self) -> None:
        """End the server; workers end when their input does."""
        if self._socket is not None:
            with suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)
        if self._process is not None:
            try:
                self._process.wait(5.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    def _start(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        environment = dict(os.environ)
        bound_environment(environment, self._threads)
        path = json.dumps([place for place in sys.path if place])  # "" would mean the current folder
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603 (our own code)
                [sys.executable, "-P", "-X", "faulthandler", "-c", _BOOT, path, str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=environment,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
        self._socket = ours
        threading.Thread(target=self._hear, args=(ours,), daemon=True).start()

    def _hear(self, ours: socket.socket) -> None:
        """Take the answers of the server until it ends."""
        with suppress(OSError):
            while message := ours.recv(_MESSAGE_BYTES):
                answer = json.loads(message)
                if "started" in answer:
                    self._pids.put(answer["started"])
                else:
                    self._end(answer["ended"], answer["status"])
        self._pids.put(0)
        with self._state:
            left = list(self._running.values())
        for process in left:  # nobody will say how they ended
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            process.note_end(-signal.SIGKILL)
        ours.close()

    def _end(self, pid: int, status: int) -> None:
        with self._state:
            process = self._running.pop(pid, None)
            if process is None:  # it has ended before its start was known
                self._ended_early[pid] = status
        if process is not None:
            process.note_end(status)


@contextmanager
def _pipes() -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Open two pipes, and close them."""
    with ExitStack() as opened:
        pipes = []
        for _ in range(2):
            pipes.append(os.pipe())
            for end in pipes[-1]:
                opened.callback(os.close, end)
        yield pipes[0], pipes[1]


def serve(descriptor: int) -> None:
    """Load what workers need, and fork them as the main process asks, until it closes the socket."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process handles interrupts
    worker.adopt_orphans()
    from pano_mvs.engine.executors.unit_requests import load_installed

    gc.disable()  # hardly anything that is imported is ever freed
    load_installed()
    for name in _PRELOADED:
        importlib.import_module(name)
    gc.freeze()  # collecting in a worker would copy all pages that it shares with this process
    asked = socket.socket(fileno=descriptor)
    woken, wake = os.pipe()
    for end in (woken, wake):
        os.set_blocking(end, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake)
    server = _Server(asked, (woken, wake))
    server.serve()
    os._exit(0)


class _Server:
    def __init__(self, asked: socket.socket, wakeup: tuple[int, int]) -> None:
        self._asked, self._wakeup = asked, wakeup
        self._workers: set[int] = set()

    def serve(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._asked, selectors.EVENT_READ)
            selector.register(self._wakeup[0], selectors.EVENT_READ)
            while True:
                ready = [key.fileobj for key, _ in selector.select()]
                if self._wakeup[0] in ready:
                    with suppress(BlockingIOError):
                        os.read(self._wakeup[0], 512)
                    self._report_ended()
                if self._asked in ready and not self._answer(selector.close):
                    return

    def _answer(self, close: Callable[[], None]) -> bool:
        """Fork a worker; return whether the main process was there."""
        message, streams, _, _ = socket.recv_fds(self._asked, _MESSAGE_BYTES, 3)
        if not message:
            return False
        pid = 0
        if len(children(Path("/proc/self/task"))) == 1:  # a plugin may have started threads
            pid = os.fork()
            if not pid:
                close()
                self._become_worker(json.loads(message)["mark"], streams)
        for stream in streams:
            os.close(stream)
        if pid:
            self._workers.add(pid)
        self._say({"started": pid})
        return True

    def _become_worker(self, mark: str, streams: list[int]) -> None:
        """Be a worker; it does not return."""
        try:
            gc.enable()
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            self._asked.close()
            for end in self._wakeup:
                os.close(end)
            os.setsid()
            for stream, standard in zip(streams, range(3), strict=True):
                os.dup2(stream, standard)
                os.close(stream)
            os.environ[worker.MARK] = mark
            worker.main()
        except BaseException:
            traceback.print_exc()
        os._exit(1)

    def _report_ended(self) -> None:
        ended: dict[int, int] = {}
        with suppress(ChildProcessError):
            while True:
                pid, status = os.waitpid(-1, os.WNOHANG)
                if not pid:
                    break
                ended[pid] = os.waitstatus_to_exitcode(status)
        for pid in ended.keys() & self._workers:
            self._workers.discard(pid)
            self._end_orphans()
            self._say({"ended": pid, "status": ended[pid]})

    def _end_orphans(self) -> None:
        """End what workers have left behind, which this process has adopted."""
        while left := worker.children_of(os.getpid()) - self._workers:
            for pid in left:
                with suppress(ProcessLookupError, PermissionError):
                    os.kill(pid, signal.SIGKILL)
                with suppress(ChildProcessError):
                    os.waitpid(pid, 0)

    def _say(self, answer: dict[str, int]) -> None:
        with suppress(OSError):  # the main process has ended, and so will this one
            self._asked.send(json.dumps(answer).encode())
