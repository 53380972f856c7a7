"""One line that says how the rig is doing."""
import shutil
import sys
import time

CONFIDENCE = ("failed", "low", "medium", "high")


def duration(seconds):
    if seconds is None:
        return ""
    if seconds < 3600:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.0f} h"


def size(count):
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"


def source_part(name, report, done, problem):
    """`report` is what the source says on /diagnostics: {key: value}, or None."""
    if done:
        return f"{name} ended"
    if problem:
        return f"{name} DOWN"
    if report is None:
        return f"{name} starts"
    text = f"{name} {report.get('rate [Hz]', '0.0')} Hz"
    if "packets lost" in report:
        text += f" {report['packets lost']} lost"
    if int(report.get("dropped by fault", 0)):
        text += f" {report['dropped by fault']} dropped"
    if int(report.get("held back", 0)):
        text += f" {report['held back']} held"
    if "confidence" in report:
        text += f" confidence {CONFIDENCE[int(report['confidence'])]}"
    if "silent" in report.get("message", ""):
        text += " SILENT"
    return text


class Counter:
    """Rate of a number that grows."""

    def __init__(self):
        self.samples = []

    def rate(self, value):
        now = time.monotonic()
        if self.samples and value < self.samples[-1][1]:
            self.samples = []  # it began anew
        self.samples = [(t, v) for t, v in self.samples if now - t < 5.0] + [(now, value)]
        (t0, v0), (t1, v1) = self.samples[0], self.samples[-1]
        return (v1 - v0) / (t1 - t0) if t1 - t0 >= 0.5 else 0.0


class StatusLine:
    """Shows the line in place on a terminal, every ten seconds elsewhere."""

    def __init__(self, stream=None, every_s=10.0):
        self.stream = stream or sys.stdout
        self.terminal = self.stream.isatty()
        self.every_s = every_s
        self.shown = -1e9
        self.open = False

    def show(self, text, now=False):
        if self.terminal:
            width = shutil.get_terminal_size().columns - 1
            self._write("\r\033[K" + text[:width])
            self.open = True
        elif now or time.monotonic() - self.shown >= self.every_s:
            self.shown = time.monotonic()
            self._write(text + "\n")

    def say(self, text):
        """A message of its own line."""
        self._write(("\r\033[K" if self.open else "") + "driver_bridge: " + text + "\n")
        self.open = False

    def _write(self, text):
        try:
            self.stream.write(text)
            self.stream.flush()
        except (OSError, ValueError):
            pass  # whoever read it is gone: no reason to stop recording
