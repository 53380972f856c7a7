"""Processes that are started again when they die, and taken over by a bridge that was itself."""
import os
import signal
import subprocess
import time

HEALTHY_S = 30.0      # a process that ran this long starts its back-off anew
FIRST_DELAY_S = 0.5   # after the second death; the first is answered at once
LONGEST_DELAY_S = 30.0


def process_start(pid):
    """When a process was started, in the kernel's ticks; None when it does not run any more.

    With the pid it names a process for good: pids are used again, the pair is not.
    """
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii", errors="replace") as f:
            fields = f.read().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else int(fields[19])


class Child:
    """One supervised process."""

    def __init__(self, name, command, log_path, pass_fds=(), ends=True):
        """
        @param command  Called before each start; gives the argument list, or raises OSError.
        @param ends     Exit status 0 says that it has done its work; else it is started again.
        """
        self.ends = ends
        self.name = name
        self.command = command
        self.log_path = log_path
        self.pass_fds = pass_fds
        self.restarts = 0     # how often it was started again
        self.problem = ""     # what it said last when it died
        self.done = False     # it ended by itself, as it should
        self.wanted = True
        self.pid = None
        self.started_ticks = None
        self._popen = None
        self._failures = 0
        self._next_start = 0.0
        self._last_start = 0.0
        self._log_at = 0

    # --- What outlives the bridge --------------------------------------------------------------

    def state(self):
        return {"pid": self.pid or 0, "ticks": self.started_ticks or 0, "restarts": self.restarts,
                "done": self.done}

    def adopt(self, state):
        """Takes over what a bridge that died had started. @return  True when it still runs."""
        self.restarts = state["restarts"]
        self.done = state["done"]
        if state["pid"] and process_start(state["pid"]) == state["ticks"]:
            self.pid, self.started_ticks = state["pid"], state["ticks"]
            self._last_start = time.monotonic()
            return True
        return False

    # --- Life ----------------------------------------------------------------------------------

    def running(self):
        if self.pid is None:
            return False
        if self._popen is not None:
            return self._popen.poll() is None
        return process_start(self.pid) == self.started_ticks

    def start(self):
        now = time.monotonic()
        self._last_start = now
        try:
            with open(self.log_path, "ab") as log:
                self._log_at = log.tell()
                # A session of its own: Ctrl-C is for the bridge, which ends its children in order.
                self._popen = subprocess.Popen(
                    self.command(), stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
                    start_new_session=True,
                    pass_fds=self.pass_fds() if callable(self.pass_fds) else self.pass_fds)
        except OSError as error:
            self.pid = None
            self._popen = None
            self._failed(str(error))
            return
        self.pid = self._popen.pid
        self.started_ticks = process_start(self.pid)

    def _failed(self, problem):
        now = time.monotonic()
        if now - self._last_start > HEALTHY_S:
            self._failures = 0
        delay = 0.0 if self._failures == 0 else min(
            LONGEST_DELAY_S, FIRST_DELAY_S * 2 ** (self._failures - 1))
        self._failures += 1
        self._next_start = now + delay
        self.problem = problem

    def last_words(self):
        """The last line that the process printed."""
        try:
            with open(self.log_path, "rb") as log:
                log.seek(self._log_at)
                lines = log.read()[-4000:].decode("utf-8", "replace").split("\n")
        except OSError:
            return ""
        lines = [line.strip() for line in lines if line.strip()]
        return lines[-1] if lines else ""

    def tend(self):
        """Starts it when it should run and does not.

        @return  What has happened, one line, or "".
        """
        if not self.wanted or self.done or self.running():
            return ""
        if self.pid is not None:
            code = self._popen.returncode if self._popen is not None else None
            self.pid = None
            if code == 0 and self.ends:
                self.done = True
                return ""
            why = (f"was killed by {signal.Signals(-code).name}" if code is not None and code < 0
                   else f"ended: {self.last_words()}" if code is not None else "has died")
            before = self.problem
            self._failed(why)
            if code is not None and code > 0 and why == before:
                return ""  # said already
            return f"{self.name} {why}; it is started again"
        if time.monotonic() < self._next_start:
            return ""
        if self._failures:
            self.restarts += 1
        before = self.problem
        self.start()
        if self.pid is None and self.problem != before:
            return f"{self.name} cannot be started: {self.problem}"
        return ""

    def signal(self, number):
        if not self.running():
            return
        try:
            os.kill(self.pid, number)
        except ProcessLookupError:
            pass

    def stop(self, patience_s=5.0):
        """Asks it to end, then makes it."""
        self.wanted = False
        for number, patience in ((signal.SIGINT, patience_s), (signal.SIGTERM, 2.0),
                                 (signal.SIGKILL, 2.0)):
            self.signal(number)
            deadline = time.monotonic() + patience
            while self.running():
                if time.monotonic() > deadline:
                    break
                time.sleep(0.02)
            else:
                return


def stop_all(children, patience_s=5.0):
    """Ends several at once."""
    for child in children:
        child.wanted = False
        child.signal(signal.SIGINT)
    for child in children:
        child.stop(patience_s)
