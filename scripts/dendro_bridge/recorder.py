"""The recording: rosbag record under supervision, safe against power cuts and a full disk.

rosbag splits the bag; what it has written is made to reach the disk here: the part in work every second,
a finished part at once and for good. A part that was cut off stays `.bag.active`; `rosbag reindex` mends
it.
"""
import glob
import os
import threading
import time

from .children import Child

CHUNK_KB = 64         # a killed recorder loses the chunk in work: one revolution of packets
BUFFER_MB = 256
SYNC_EVERY_S = 1.0
SPACE_AGAIN = 1.2     # recording begins again when this times the limit is free


def find_record():
    """The program behind `rosbag record`, without the wrapper that would survive it."""
    import roslib.packages  # not needed to check a script
    found = roslib.packages.find_node("rosbag", "record")
    if not found:
        raise FileNotFoundError("rosbag record is not installed (Debian: python3-rosbag)")
    return found[0]


class Recorder:
    """Records some topics into FOLDER/rig_DATE-*.bag."""

    def __init__(self, settings, topics, node_name, run_folder, prefix, before_stop):
        """@param before_stop  Called before the recording stops for good: nobody is to wait for it."""
        self.folder = settings["folder"]
        os.makedirs(self.folder, exist_ok=True)
        self.min_free = settings["min_free_mb"] * 1000000
        self.topics = topics
        self.node_name = node_name
        self.prefix = os.path.join(self.folder, prefix)
        self.split_mb = settings["split_mb"]
        self.record = find_record()
        self.full = False
        self.before_stop = before_stop
        self.child = Child("recorder", self._command, os.path.join(run_folder, "recorder.log"),
                           ends=False)
        self._synced = set()
        self._looked = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._sync_loop, daemon=True)
        self._thread.start()

    def _command(self):
        # rig_DATE-START_PART.bag: no start writes over what another has left.
        return [self.record, "--split", f"--size={self.split_mb}", f"--chunksize={CHUNK_KB}",
                f"--buffsize={BUFFER_MB}", "--min-space=1k", "--repeat-latched", "--tcpnodelay",
                "-O", f"{self.prefix}-{self.child.restarts}", *self.topics,
                f"__name:={self.node_name.lstrip('/')}"]

    # --- Disk ------------------------------------------------------------------------------------

    def free_bytes(self):
        info = os.statvfs(self.folder)
        return info.f_bavail * info.f_frsize

    def files(self):
        """(finished, in work) of this run."""
        every = glob.glob(glob.escape(self.prefix) + "-*")
        return (sorted(f for f in every if f.endswith(".bag")),
                sorted(f for f in every if f.endswith(".bag.active")))

    def bytes(self):
        done, active = self.files()
        total = 0
        for path in done + active:
            try:
                total += os.path.getsize(path)
            except OSError:
                pass  # just renamed
        return total

    def cut_off(self):
        """Parts that a recorder which died left behind; the one in work is not among them."""
        active = self.files()[1]
        if self.child.running() and active:
            active.remove(max(active, key=os.path.getmtime))
        return active

    def _sync_loop(self):
        while not self._stop.wait(SYNC_EVERY_S):
            self._sync()

    def _sync(self):
        done, active = self.files()
        for path in active:
            self._sync_file(path, os.fdatasync)
        for path in set(done) - self._synced:
            if self._sync_file(path, os.fsync):
                self._sync_file(self.folder, os.fsync)
                self._synced.add(path)

    @staticmethod
    def _sync_file(path, sync):
        try:
            fd = os.open(path, os.O_RDONLY)
        except OSError:
            return False
        try:
            sync(fd)
            return True
        except OSError:
            return False
        finally:
            os.close(fd)

    # --- Life ------------------------------------------------------------------------------------

    def tend(self):
        """@return  What has happened, one line, or ""."""
        free = self.free_bytes()
        if self.full:
            if self.min_free and free > SPACE_AGAIN * self.min_free:
                self.full = False
                self.child.wanted = True
                self.child.done = False
                return f"there is space on the disk again: recording goes on in {self.folder}"
            return ""
        limit = max(self.min_free, 100000)
        died = self.child.pid is not None and not self.child.running()
        refused = died or self._has_given_up()
        if free < limit or (refused and self._says_full()):
            self.full = True
            self.before_stop()
            self.child.stop(10.0)
            self.child.pid = None
            return (f"recording has stopped: {free / 1e6:.0f} MB are left on the disk of "
                    f"{self.folder}; {self.bytes() / 1e6:.0f} MB are recorded, mapping goes on")
        return self.child.tend()

    def _has_given_up(self):
        """rosbag goes on without writing when its own look at the disk says so."""
        now = time.monotonic()
        if now - self._looked < 1.0:
            return False
        self._looked = now
        return self.child.running() and "disabled" in self.child.last_words().lower()

    def _says_full(self):
        words = self.child.last_words().lower()
        return any(w in words for w in ("no space", "error writing", "file too large", "disabled",
                                        "disk is full", "full disk"))

    def stop(self):
        """Closes the bag; what was recorded is on the disk afterwards."""
        self.child.stop(20.0)
        self._stop.set()
        self._thread.join()
        self._sync()

    def seconds_left(self, rate_bytes_per_s):
        if rate_bytes_per_s <= 0:
            return None
        return max(0.0, self.free_bytes() - self.min_free) / rate_bytes_per_s


class RateOfBytes:
    """How fast the recording grows, over the last ten seconds."""

    def __init__(self):
        self.samples = []

    def add(self, total):
        now = time.monotonic()
        self.samples = [(t, b) for t, b in self.samples if now - t < 10.0] + [(now, total)]

    def per_second(self):
        if len(self.samples) < 2 or self.samples[-1][0] - self.samples[0][0] < 1.0:
            return 0.0
        (t0, b0), (t1, b1) = self.samples[0], self.samples[-1]
        return (b1 - b0) / (t1 - t0)
