"""A worker process that reads, compiles and diagnoses drawings.

If a request takes too long, its process is killed, and the server keeps running. Requests and answers are JSON, so that
nothing from a scene is ever unpickled.
"""

import json
import multiprocessing
import os
import threading
import traceback
from collections.abc import Callable, Mapping
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from udkjax.studio.limits import RefusedError

TASKS_MODULE = "udkjax.studio.tasks"
END_SECONDS = 5.0  # time to wait for a killed process


class Worker:
    """A separate process that runs the functions of `tasks.py` one at a time, and that is replaced if a function takes too long.

    Args:
        folder: the working directory of the process, to which the files of outlines in drawings are relative; by default, that of
            this process.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder, self._lock = folder, threading.Lock()
        self._process: Any = None
        self._connection: Connection | None = None

    def start(self) -> None:
        """Start the process, so that its imports are done before the first request."""
        with self._lock:
            self._ensure()

    def call(self, name: str, arguments: Mapping[str, Any], seconds: float) -> dict[str, Any]:
        """Return the answer of the task `name`; raise `RefusedError` if it refuses, fails, or takes longer than `seconds`."""
        with self._lock:
            connection = self._ensure()
            try:
                connection.send_bytes(json.dumps({"name": name, "arguments": arguments}).encode())
                if not connection.poll(seconds):
                    self._stop()
                    raise RefusedError(504, f"this took longer than {seconds:g} s and was stopped: simplify the drawing")
                answer = json.loads(connection.recv_bytes())
            except (EOFError, OSError):
                self._stop()
                raise RefusedError(500, "the worker process ended unexpectedly and is started again") from None
        if "problem" in answer:
            raise RefusedError(answer["status"], answer["problem"], **answer["details"])
        return answer["result"]

    @property
    def is_busy(self) -> bool:
        """True while a task runs."""
        return self._lock.locked()

    def close(self) -> None:
        with self._lock:
            self._stop()

    def _ensure(self) -> Connection:
        if self._process is None or not self._process.is_alive() or self._connection is None:
            self._stop()
            context = multiprocessing.get_context("spawn")
            self._connection, child_end = context.Pipe()
            self._process = context.Process(target=_serve, args=(child_end, self._folder), daemon=True, name="udkjax studio")
            self._process.start()
            child_end.close()
        return self._connection

    def _stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join(END_SECONDS)
        if self._connection is not None:
            self._connection.close()
        self._process = self._connection = None


class WorkerPool:
    """Several workers, of which a free one runs a task, so that a new drawing need not wait until an old one is compiled.

    Args:
        count: number of workers; only the first starts before it is needed.
        folder: the working directory of their processes.
    """

    def __init__(self, count: int, folder: Path | None = None):
        self.workers = [Worker(folder) for _ in range(count)]

    def start(self) -> None:
        """Start the first process."""
        self.workers[0].start()

    def call(self, name: str, arguments: Mapping[str, Any], seconds: float) -> dict[str, Any]:
        """Return the answer of a task, as `Worker.call` does; if no worker is free, wait for the first worker."""
        return next((one for one in self.workers if not one.is_busy), self.workers[0]).call(name, arguments, seconds)

    def close(self) -> None:
        for worker in self.workers:
            worker.close()


def _serve(connection: Connection, folder: Path | None) -> None:
    """Answer requests, each with the name and the arguments of a task, until the connection is closed."""
    if folder is not None:
        os.chdir(folder)
    tasks = import_module(TASKS_MODULE)
    while True:
        try:
            request = json.loads(connection.recv_bytes())
        except (EOFError, OSError, KeyboardInterrupt):
            return
        task: Callable[..., dict[str, Any]] = getattr(tasks, request["name"])
        try:
            answer = {"result": task(**request["arguments"])}
            data = json.dumps(answer, allow_nan=False).encode()
        except KeyboardInterrupt:
            return
        except RefusedError as error:
            data = json.dumps({"problem": str(error), "status": error.status, "details": error.details}).encode()
        except Exception as error:  # a defect of the package: shown in full in the terminal, in one line on the page
            traceback.print_exc()
            problem = f"{type(error).__name__}: {error}"
            data = json.dumps({"problem": problem, "status": 500, "details": {}}).encode()
        connection.send_bytes(data)
