#!/usr/bin/env python3
"""Times the network of stage 1 beside ONNX Runtime on the plain ERFNet, and compares it with PyTorch.

    scripts/setup_oracles onnxruntime
    build/oracles/bin/python scripts/benchmark_segmentation.py [--passes N] [--json]
    build/oracles/bin/python scripts/benchmark_segmentation.py --agreement 100
    scripts/benchmark_segmentation.py --scenes [--rows 32 --cols 360] [--weights FILE] [--scans N] [--seed N]

The peer is ERFNet as published (Romera et al. 2018: 2.06 million parameters), with the five planes of
RangeNet++ and two classes, exported from PyTorch into a temporary folder, run by ONNX Runtime on one
thread. Both see an image of the same size; they take turns, and times are processor time of the
process, so that what else runs on the machine weighs little. The ratio is the median over pairs.

--agreement N simulates N scans, never trained on, runs them through the C++ network and through
PyTorch and prints the largest difference of a logit and the part of the pixels with the same label.

--scenes scores the scenes of config/scenes/ along their paths and --scans scans of every kind of random scene
(score_segmentation), none of them trained on, and prints a table per scene and range.
"""
import argparse
import json
import pathlib
import subprocess
import sys
import tempfile
import time

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

ROOT = pathlib.Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "scripts"))
import train_segmentation as training  # noqa: E402

PROGRAMS = training.PROGRAMS


def canvas_columns(cols):
    """Columns the network is run on: empty ones fill up what its strides do not divide."""
    return -(-cols // 16) * 16


class PlainDown(nn.Module):
    def __init__(self, c_in, c_out):
        super().__init__()
        self.conv = nn.Conv2d(c_in, c_out - c_in, 3, 2, 1)
        self.bn = training.batch_norm(c_out)

    def forward(self, x):
        return F.relu(self.bn(torch.cat([self.conv(x), F.max_pool2d(x, 2)], 1)))


class PlainUp(nn.Module):
    def __init__(self, c_in, c_out):
        super().__init__()
        self.conv = nn.ConvTranspose2d(c_in, c_out, 3, 2, 1, 1)
        self.bn = training.batch_norm(c_out)

    def forward(self, x):
        return F.relu(self.bn(self.conv(x)))


def plain_erfnet(planes=5, classes=2):
    def block(c, d):
        return training.NonBottleneck1d(c, (d, d), 0.0)

    return nn.Sequential(
        PlainDown(planes, 16), PlainDown(16, 64), *[block(64, 1) for _ in range(5)],
        PlainDown(64, 128), *[block(128, d) for d in (2, 4, 8, 16, 2, 4, 8, 16)],
        PlainUp(128, 64), block(64, 1), block(64, 1),
        PlainUp(64, 16), block(16, 1), block(16, 1), nn.ConvTranspose2d(16, classes, 2, 2)).eval()


class Passes:
    """The C++ network as a process that does one pass per line."""

    def __init__(self, weights, planes, rows, cols, logits=None):
        command = [str(PROGRAMS / "segmentation_benchmark"), "--planes", str(planes), "--rows",
                   str(rows), "--cols", str(cols)]
        if weights:
            command += ["--weights", str(weights)]
        if logits:
            command += ["--logits", str(logits)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def run(self, image):
        self.process.stdin.write(f"{image}\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit("benchmark_segmentation: segmentation_benchmark ended")
        return tuple(float(v) for v in line.split())

    def close(self):
        self.process.stdin.close()
        if self.process.wait():
            raise SystemExit("benchmark_segmentation: segmentation_benchmark failed")


def time_beside_onnx_runtime(args):
    try:
        import onnxruntime
    except ImportError:
        raise SystemExit("benchmark_segmentation: needs the onnxruntime wheel, see --help")
    torch.set_num_threads(1)
    torch.manual_seed(1)
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        rng = np.random.default_rng(1)
        width = canvas_columns(args.cols)
        rng.standard_normal((1, training.PLANES, args.rows, width), np.float32).tofile(folder / "planes.f32")
        x = rng.standard_normal((1, 5, args.rows, args.cols), np.float32)
        net = plain_erfnet()
        torch.onnx.export(net, torch.from_numpy(x), str(folder / "plain.onnx"), opset_version=13)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        session = onnxruntime.InferenceSession(str(folder / "plain.onnx"), options,
                                               providers=["CPUExecutionProvider"])
        name = session.get_inputs()[0].name
        ours = Passes(args.weights, folder / "planes.f32", args.rows, width)
        pairs = []
        for k in range(args.passes + 3):
            cpu = ours.run(0)[1]
            start = time.process_time()
            session.run(None, {name: x})
            peer = 1e3 * (time.process_time() - start)
            if k >= 3:  # Both have laid out their memory by then.
                pairs.append((cpu, peer))
        ours.close()
    pairs = np.array(pairs)
    return {"image": f"{args.rows} x {args.cols}", "passes": args.passes,
            "ours_ms": round(float(np.median(pairs[:, 0])), 2),
            "onnx_runtime_plain_erfnet_ms": round(float(np.median(pairs[:, 1])), 2),
            "ratio": round(float(np.median(pairs[:, 0] / pairs[:, 1])), 3),
            "plain_erfnet_parameters": sum(p.numel() for p in net.parameters()),
            "onnx_runtime": onnxruntime.__version__}


def agreement(args):
    """Largest difference of a logit and share of equal labels, C++ against PyTorch."""
    native = args.rows == 16
    weights = args.weights or ROOT / f"config/models/erfnet_wood{'' if native else '_32x360'}.safetensors"
    torch.set_num_threads(1)
    net = training.load_exported(weights)
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        subprocess.run([str(PROGRAMS / "simulate_training_scans"), "-o", str(folder / "scans"), "--scans",
                        str(args.agreement), "--seed", "6000000", "--rows", str(args.rows), "--cols",
                        str(args.cols)] + ([] if native else ["--model", "uniform"]), check=True)
        data = training.Dataset([folder / "scans"])
        width = canvas_columns(args.cols)
        planes = np.zeros((args.agreement, training.PLANES, args.rows, width), np.float32)
        planes[..., :args.cols] = np.stack(data.planes)
        planes.tofile(folder / "planes.f32")
        passes = Passes(weights, folder / "planes.f32", args.rows, width, folder / "logits.f32")
        for i in range(args.agreement):
            passes.run(i)
        passes.close()
        logits = np.fromfile(folder / "logits.f32", np.float32).reshape(args.agreement, -1, args.rows, width)
    worst, same, total, largest = 0.0, 0, 0, 0.0
    with torch.no_grad():
        for i in range(args.agreement):
            expected = net(torch.from_numpy(planes[i:i + 1]))[0].numpy()
            worst = max(worst, float(np.abs(expected - logits[i]).max()))
            largest = max(largest, float(np.abs(expected).max()))
            seen = planes[i, training.MASK] > 0.5
            same += int((expected.argmax(0) == logits[i].argmax(0))[seen].sum())
            total += int(seen.sum())
    return {"scans": args.agreement, "largest_logit_difference": worst, "largest_logit": largest,
            "same_label": same / total, "pixels": total}


# Scene, path, and which scans of it are scored.
SCENES = [("thesis_tree", "thesis_quadrangle", 100), ("thesis_tree_pillars", "thesis_quadrangle", 100),
          ("saguaro", "circle", 60), ("savanna", "savanna_walk", 20), ("orchard_row", "orchard_walk", 60),
          ("palo_verde", "helix", 60)]


def scene_scores(args):
    """The scores of score_segmentation by scene or kind of random scene."""
    image = ["--rows", str(args.rows), "--cols", str(args.cols)] + ([] if args.rows == 16 else ["--model", "uniform"])
    weights = ["--weights", str(args.weights)] if args.weights else []

    def score(*options):
        output = subprocess.run([str(PROGRAMS / "score_segmentation"), "--methods", "network", *image, *weights, *options],
                                check=True, capture_output=True, text=True).stdout
        return json.loads(output)["network"]

    scores = {}
    for scene, path, every in SCENES:
        result = score("--scene", str(ROOT / f"config/scenes/{scene}.yaml"),
                       "--path", str(ROOT / f"config/paths/{path}.yaml"), "--every", str(every))
        scores[f"{scene}, {path}"] = next(iter(result.values()))
    scores.update({f"random, {kind}": entry for kind, entry in score(
        "--scans", str(args.scans), "--scans-per-scene", "2", "--seed", str(args.seed)).items()})
    return scores


def scene_table(scores):
    """A Markdown table: all ranges, then IoU / recall of wood by range."""
    bins = sorted(next(iter(scores.values()))["by_range"], key=lambda name: float(name.split("-")[0]))
    lines = ["| scene | wood IoU | accuracy | recall | beyond 8 m | " +
             " | ".join(name.replace("16-200m", "over 16m").replace("m", " m") for name in bins) + " | ms |",
             "|---" * (6 + len(bins)) + "|"]

    def show(value):
        return "-" if value is None else f"{value:.3f}"

    for name, entry in scores.items():
        # A handful of pixels says nothing.
        ranges = [f"{show(r['wood_iou'])} / {show(r['wood_recall'])}" if r["wood_pixels"] >= 50 else "-"
                  for r in (entry["by_range"][name] for name in bins)]
        lines.append(f"| {name} | {show(entry['wood_iou'])} | {entry['accuracy']:.4f} | {show(entry['wood_recall'])} | "
                     f"{show(entry['wood_recall_beyond_8m'])} | " + " | ".join(ranges) +
                     f" | {entry['cpu_ms_median']:.1f} |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=pathlib.Path, help="default: the shipped ones")
    parser.add_argument("--rows", type=int, default=16)
    parser.add_argument("--cols", type=int, default=1800)
    parser.add_argument("--passes", type=int, default=60)
    parser.add_argument("--agreement", type=int, default=0, metavar="SCANS")
    parser.add_argument("--scenes", action="store_true")
    parser.add_argument("--scans", type=int, default=24, help="of every kind of random scene, with --scenes")
    parser.add_argument("--seed", type=int, default=5000000, help="of the first random scene, with --scenes")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    if args.scenes:
        scores = scene_scores(args)
        print(json.dumps(scores) if args.json else scene_table(scores))
        return
    result = agreement(args) if args.agreement else time_beside_onnx_runtime(args)
    if args.json:
        print(json.dumps(result))
    else:
        for key, value in result.items():
            print(f"{key:32s} {value}")


if __name__ == "__main__":
    main()
