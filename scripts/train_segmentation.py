#!/usr/bin/python3
"""Trains the network of stage 1 (wood in the range image) on simulated scans.

  scripts/train_segmentation.py                     simulate data if there is none, train, export
  scripts/train_segmentation.py --resume            go on where an interrupted training stopped
  scripts/train_segmentation.py --init FILE         train exported weights on, with more or other data
  scripts/train_segmentation.py --evaluate FILE     score a weights file on the held-out scans
  scripts/train_segmentation.py --image 32x360      the same for the thesis' size of image
  scripts/train_segmentation.py --fixture DIR       write the small network the C++ test compares with

The data comes from the program simulate_training_scans (scripts/build builds it): range images
already turned into the input planes of dendro_slam/segmentation/network_input.h, and a label per
pixel. Training is in two steps as in the thesis: first the encoder with a coarse head on the
downsampled labels, then the decoder with the encoder frozen; a third, joint step (a deviation)
follows, because the skip connections hand the encoder's fine features to the decoder.

Needs only Debian's python3-torch and python3-numpy. Uses a GPU if PyTorch sees one.
"""
import argparse
import datetime
import json
import os
import pathlib
import queue
import struct
import subprocess
import sys
import threading
import time

import numpy as np
import torch
import torch.distributed
import torch.multiprocessing
import torch.nn as nn
import torch.nn.functional as F

ROOT = pathlib.Path(__file__).resolve().parent.parent
PROGRAMS = pathlib.Path(os.environ.get("DENDRO_BUILD_DIR", ROOT / "build")) / "devel/lib/dendro_slam"
CLASSES = ["ground", "wood", "leaf", "other"]
WOOD, OTHER = 1, 3
INPUT = "dendro_range_planes_4"
PLANES = 21
(MASK, RANGE, INTENSITY, HEIGHT, UP, LATERAL, VERTICAL, RISE, SIDE,
 WIDTH, BRIGHTNESS, BULGE, SLANT, ROUGHNESS,
 LINE_SUPPORT, LINE_ROWS, LINE_BEND, LINE_DEPTH, LINE_SLOPE, LINE_LIKENESS, LINE_ELSEWHERE) = range(PLANES)
IGNORE = 255

# Rows are few: the first halving is of columns only. Blocks are cheap where the image is small, so most are there.
LAYERS = ("stem:16:3x5:1x2 push "
          "down:32:1x2 nb:1x1 push "
          "down:64:2x2 nb:1x1 nb:1x2 push "
          "down:96:2x2 nb:1x1 nb:1x2 nb:1x4 "
          "grow:64:1x1:2x2 add "
          "grow:32:1x1:2x2 add conv:32:3x3 "
          "grow:16:1x1:1x2 add conv:32:3x3 "
          "last:4:1x1:1x2")
# A pixel of the thesis' image is a whole degree: no azimuth to spare for a stride in the input layer.
LAYERS_32X360 = ("stem:16:3x5:1x1 push "
                 "down:32:2x2 nb:1x1 nb:1x2 push "
                 "down:64:2x2 nb:1x1 nb:1x2 nb:1x4 nb:1x8 "
                 "grow:32:1x1:2x2 add conv:32:3x3 nb:1x1 "
                 "grow:16:1x1:2x2 add conv:32:3x3 "
                 "last:4:1x1:1x1")
FIXTURE_LAYERS = ("stem:6:3x5:1x2 nb:1x1 push down:10:2x2 nb:1x2 push down:14:2x1 nb:2x4 "
                  "grow:10:1x1:2x1 add conv:7:3x5 grow:6:3x3:2x2 add last:4:1x3:1x2")


# ---------------------------------------------------------------------------------------------
# Network. The words of a layer list are described in dendro_slam/segmentation/erfnet.h.
# ---------------------------------------------------------------------------------------------
def pair(text):
    return tuple(int(v) for v in text.split("x"))


def batch_norm(channels):
    return nn.BatchNorm2d(channels, eps=1e-3)


class Stem(nn.Module):
    def __init__(self, c_in, c_out, kernel, stride):
        super().__init__()
        self.conv = nn.Conv2d(c_in, c_out, kernel, stride, (kernel[0] // 2, kernel[1] // 2), bias=False)
        self.bn = batch_norm(c_out)

    def forward(self, x):
        return F.relu(self.bn(self.conv(x)))

    def export(self):
        return fold("conv", self.conv, self.bn)


class Conv(Stem):
    def __init__(self, c_in, c_out, kernel):
        super().__init__(c_in, c_out, kernel, (1, 1))


class Down(nn.Module):
    """Convolution beside max pooling, one batch normalisation over both (ERFNet)."""

    def __init__(self, c_in, c_out, stride):
        super().__init__()
        self.conv = nn.Conv2d(c_in, c_out - c_in, 3, stride, 1, bias=False)
        self.pool = nn.MaxPool2d(stride, stride)
        self.bn = batch_norm(c_out)

    def forward(self, x):
        return F.relu(self.bn(torch.cat([self.conv(x), self.pool(x)], 1)))

    def export(self):
        scale, shift = affine(self.bn)
        n = self.conv.weight.shape[0]
        return {"conv.weight": self.conv.weight * scale[:n, None, None, None],
                "conv.bias": shift[:n], "pool.weight": scale[n:], "pool.bias": shift[n:]}


class NonBottleneck1d(nn.Module):
    def __init__(self, c, dilation, dropout):
        super().__init__()
        dh, dw = dilation
        self.conv1 = nn.Conv2d(c, c, (3, 1), 1, (1, 0))
        self.conv2 = nn.Conv2d(c, c, (1, 3), 1, (0, 1), bias=False)
        self.bn1 = batch_norm(c)
        self.conv3 = nn.Conv2d(c, c, (3, 1), 1, (dh, 0), (dh, 1))
        self.conv4 = nn.Conv2d(c, c, (1, 3), 1, (0, dw), (1, dw), bias=False)
        self.bn2 = batch_norm(c)
        self.dropout = nn.Dropout2d(dropout)

    def forward(self, x):
        y = F.relu(self.conv1(x))
        y = F.relu(self.bn1(self.conv2(y)))
        y = F.relu(self.conv3(y))
        y = self.dropout(self.bn2(self.conv4(y)))
        return F.relu(y + x)

    def export(self):
        return {"conv1.weight": self.conv1.weight, "conv1.bias": self.conv1.bias,
                **fold("conv2", self.conv2, self.bn1),
                "conv3.weight": self.conv3.weight, "conv3.bias": self.conv3.bias,
                **fold("conv4", self.conv4, self.bn2)}


def interleave(x, stride):
    """Channels to pixels: torch's pixel_shuffle with a stride per axis."""
    n, c, h, w = x.shape
    sh, sw = stride
    x = x.view(n, c // (sh * sw), sh, sw, h, w).permute(0, 1, 4, 2, 5, 3)
    return x.reshape(n, c // (sh * sw), h * sh, w * sw)


class Grow(nn.Module):
    def __init__(self, c_in, c_out, kernel, stride):
        super().__init__()
        self.stride = stride
        c_out *= stride[0] * stride[1]
        self.conv = nn.Conv2d(c_in, c_out, kernel, 1, (kernel[0] // 2, kernel[1] // 2), bias=False)
        self.bn = batch_norm(c_out)

    def forward(self, x):
        return interleave(F.relu(self.bn(self.conv(x))), self.stride)

    def export(self):
        return fold("conv", self.conv, self.bn)


class Last(nn.Module):
    def __init__(self, c_in, classes, kernel, stride):
        super().__init__()
        self.stride = stride
        self.conv = nn.Conv2d(c_in, classes * stride[0] * stride[1], kernel, 1,
                              (kernel[0] // 2, kernel[1] // 2))

    def forward(self, x):
        return interleave(self.conv(x), self.stride)

    def export(self):
        return {"conv.weight": self.conv.weight, "conv.bias": self.conv.bias}


def affine(bn):
    """Scale and shift of a batch normalisation at inference."""
    scale = bn.weight / torch.sqrt(bn.running_var + bn.eps)
    return scale, bn.bias - bn.running_mean * scale


def fold(name, conv, bn, out_axis=0):
    scale, shift = affine(bn)
    shape = [1, 1, 1, 1]
    shape[out_axis] = -1
    return {name + ".weight": conv.weight * scale.view(shape), name + ".bias": shift}


class ErfNet(nn.Module):
    def __init__(self, layers, planes=PLANES, dropout=0.0):
        super().__init__()
        self.spec = layers
        self.words = layers.split()
        modules, stack, c = [], [], planes
        self.encoder_length = 0
        for word in self.words:
            kind, *fields = word.split(":")
            if kind == "stem":
                modules.append(Stem(c, int(fields[0]), pair(fields[1]), pair(fields[2])))
                c = int(fields[0])
            elif kind == "down":
                modules.append(Down(c, int(fields[0]), pair(fields[1])))
                c = int(fields[0])
            elif kind == "nb":
                modules.append(NonBottleneck1d(c, pair(fields[0]), dropout))
            elif kind == "conv":
                modules.append(Conv(c, int(fields[0]), pair(fields[1])))
                c = int(fields[0])
            elif kind == "grow":
                if not self.encoder_length:
                    self.encoder_length = len(modules)
                    self.coarse_channels = c
                modules.append(Grow(c, int(fields[0]), pair(fields[1]), pair(fields[2])))
                c = int(fields[0])
            elif kind == "last":
                modules.append(Last(c, int(fields[0]), pair(fields[1]), pair(fields[2])))
            else:
                modules.append(nn.Identity())
        self.layers = nn.ModuleList(modules)
        self.coarse_head = nn.Conv2d(self.coarse_channels, len(CLASSES), 1)

    def encoder(self, x):
        kept = []
        for word, layer in zip(self.words[:self.encoder_length], self.layers):
            if word == "push":
                kept.append(x)
            else:
                x = layer(x)
        return x, kept

    def forward(self, x):
        x, kept = self.encoder(x)
        for word, layer in list(zip(self.words, self.layers))[self.encoder_length:]:
            if word == "push":
                kept.append(x)
            elif word == "add":
                x = x + kept.pop()
            else:
                x = layer(x)
        return x

    def coarse(self, x):
        return self.coarse_head(self.encoder(x)[0])

    def encoder_modules(self):
        return list(self.layers[:self.encoder_length])

    def export(self):
        tensors = {}
        for i, layer in enumerate(self.layers):
            if hasattr(layer, "export"):
                for name, value in layer.export().items():
                    tensors[f"{i:02d}.{name}"] = value.detach().cpu().float().numpy()
        metadata = {"format": "dendro_erfnet_1", "input": INPUT,
                    "input_channels": str(PLANES), "classes": ",".join(CLASSES),
                    "layers": self.spec}
        return tensors, metadata


# ---------------------------------------------------------------------------------------------
# safetensors, by hand: length, JSON header, data
# ---------------------------------------------------------------------------------------------
def write_safetensors(path, tensors, metadata=None):
    header, blobs, offset = {}, [], 0
    if metadata:
        header["__metadata__"] = metadata
    for name in sorted(tensors):
        data = np.ascontiguousarray(tensors[name], dtype="<f4")
        header[name] = {"dtype": "F32", "shape": list(data.shape),
                        "data_offsets": [offset, offset + data.nbytes]}
        blobs.append(data.tobytes())
        offset += data.nbytes
    text = json.dumps(header, sort_keys=True, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_bytes(struct.pack("<Q", len(text)) + text + b"".join(blobs))
    os.replace(temporary, path)


def read_safetensors(path):
    raw = pathlib.Path(path).read_bytes()
    size = struct.unpack("<Q", raw[:8])[0]
    header = json.loads(raw[8:8 + size])
    metadata = header.pop("__metadata__", {})
    tensors = {}
    for name, entry in header.items():
        begin, end = entry["data_offsets"]
        tensors[name] = np.frombuffer(raw[8 + size + begin:8 + size + end], "<f4").reshape(entry["shape"])
    return tensors, metadata


def load_exported(path):
    """A network whose batch normalisations are identities, from an exported file."""
    tensors, metadata = read_safetensors(path)
    net = ErfNet(metadata["layers"])
    # Planes are only ever added behind the others: a network that knew fewer does not look at them.
    stem = tensors["00.conv.weight"]
    tensors["00.conv.weight"] = np.pad(stem, ((0, 0), (0, PLANES - stem.shape[1]), (0, 0), (0, 0)))

    def identity(bn, scale=None, shift=None):
        bn.running_mean.zero_()
        bn.running_var.fill_(1.0 - bn.eps)
        bn.weight.copy_(torch.ones_like(bn.weight) if scale is None else scale)
        bn.bias.copy_(torch.zeros_like(bn.bias) if shift is None else shift)

    with torch.no_grad():
        for i, layer in enumerate(net.layers):
            def get(name):
                return torch.from_numpy(tensors[f"{i:02d}.{name}"].copy())
            if isinstance(layer, (Stem, Grow)):
                layer.conv.weight.copy_(get("conv.weight"))
                identity(layer.bn, shift=get("conv.bias"))
            elif isinstance(layer, Down):
                layer.conv.weight.copy_(get("conv.weight"))
                n = layer.conv.weight.shape[0]
                identity(layer.bn, torch.cat([torch.ones(n), get("pool.weight")]),
                         torch.cat([get("conv.bias"), get("pool.bias")]))
            elif isinstance(layer, NonBottleneck1d):
                for k in (1, 3):
                    getattr(layer, f"conv{k}").weight.copy_(get(f"conv{k}.weight"))
                    getattr(layer, f"conv{k}").bias.copy_(get(f"conv{k}.bias"))
                for k, bn in ((2, layer.bn1), (4, layer.bn2)):
                    getattr(layer, f"conv{k}").weight.copy_(get(f"conv{k}.weight"))
                    identity(bn, shift=get(f"conv{k}.bias"))
            elif isinstance(layer, Last):
                layer.conv.weight.copy_(get("conv.weight"))
                layer.conv.bias.copy_(get("conv.bias"))
    return net.eval()


@torch.no_grad()
def deepened(net, layers):
    """The same function with the layers `layers`: blocks it has beyond those of `net` add nothing as yet."""
    result = ErfNet(layers)
    old = list(zip(net.words, net.layers))
    for word, layer in zip(result.words, result.layers):
        if old and old[0][0] == word:
            layer.load_state_dict(old.pop(0)[1].state_dict())
        elif word.startswith("nb:"):
            layer.bn2.weight.zero_()
        else:
            raise SystemExit("train_segmentation: --init is of another architecture")
    if old:
        raise SystemExit("train_segmentation: --init is of another architecture")
    return result.eval()


@torch.no_grad()
def unfold(net, inputs):
    """Gives the batch normalisations of load_exported() the statistics of `inputs` back.

    The network computes the same at inference, and nearly the same on batches like these in training.
    """
    sums = {}

    def measure(bn, args):
        x = args[0].double()
        n, total, squares = sums.get(bn, (0, 0.0, 0.0))
        sums[bn] = (n + x.numel() // x.shape[1], total + x.sum((0, 2, 3)), squares + (x * x).sum((0, 2, 3)))

    norms = [m for m in net.modules() if isinstance(m, nn.BatchNorm2d)]
    hooks = [bn.register_forward_pre_hook(measure) for bn in norms]
    net.eval()
    for x in inputs:
        net(x)
    for hook in hooks:
        hook.remove()
    for bn in norms:
        n, total, squares = sums[bn]
        scale, shift = affine(bn)
        mean = total / n
        variance = (squares / n - mean * mean).clamp_min(1e-6)
        bn.running_mean.copy_(mean)
        bn.running_var.copy_(variance)
        bn.weight.copy_(scale * torch.sqrt(variance + bn.eps))
        bn.bias.copy_(shift + scale * mean)


# ---------------------------------------------------------------------------------------------
# Data
# ---------------------------------------------------------------------------------------------
class Dataset:
    """Folders of simulate_training_scans, one after the other: meta.json, planes.f16, labels.u8."""

    def __init__(self, folders):
        self.planes, self.labels, self.scans, self.seeds = [], [], [], []
        for folder in sorted(folders):
            meta = json.loads((folder / "meta.json").read_text())
            if meta["planes"] != PLANES or meta["input"] != INPUT:
                raise SystemExit(f"train_segmentation: {folder} holds other planes; simulate anew")
            self.rows, self.cols = meta["rows"], meta["cols"]
            shape = (meta["count"], PLANES, self.rows, self.cols)
            self.planes += list(np.memmap(folder / "planes.f16", "<f2", "r", shape=shape))
            labels = np.fromfile(folder / "labels.u8", np.uint8).reshape(-1, self.rows, self.cols)
            self.labels += list(np.where(labels == 0, IGNORE, labels - 1).astype(np.uint8))
            self.scans += meta["scans"]
            self.seeds.append(meta["seed"])
        self.count = len(self.planes)
        if not self.count:
            raise SystemExit("train_segmentation: no simulated scans")
        self.wood_columns = [np.flatnonzero((y == WOOD).any(0)) for y in self.labels]
        self.other_columns = [np.flatnonzero((y == OTHER).any(0)) for y in self.labels]
        self.busy_columns = [np.flatnonzero(((y != IGNORE) & (y != 0)).any(0)) for y in self.labels]

    def crop(self, index, start, width):
        columns = (start + np.arange(width)) % self.cols
        return (self.planes[index][:, :, columns].astype(np.float32),
                self.labels[index][:, columns])


def head_down(x, y):
    """The same scan by a sensor that hangs head down and is mirrored: the rows in reverse order.

    What was the step from the row below is now the step to the next row. (Head down the azimuths run
    the other way too, which the mirror of augment() sees to or not.)
    """
    x, y = x[:, ::-1].copy(), y[::-1].copy()
    mask = x[MASK] > 0.5
    both = mask[:-1] & mask[1:]
    for plane, sign, missing in ((VERTICAL, -1.0, 1.0), (RISE, 1.0, 0.0)):
        step = x[plane].copy()
        x[plane, :-1] = np.where(both, sign * step[1:], missing)
        x[plane, -1] = missing
        x[plane][~mask] = 0.0
    x[LINE_DEPTH] *= -1.0
    x[LINE_SLOPE] *= -1.0
    return x, y


def augment(x, y, rng):
    """Yaw comes from the crop's place; here mirror, head down, range scale, drop-out, intensity, ground.

    The planes of the runs and lines stay as they are where a return is dropped: they would seldom change much.
    """
    mask = x[MASK] > 0.5
    if rng.random() < 0.5:
        x, y, mask = x[:, :, ::-1].copy(), y[:, ::-1].copy(), mask[:, ::-1].copy()
        # The step to the next column becomes the step from it.
        x[SIDE] *= -1.0
        x[LINE_SLOPE] *= -1.0
        step = x[LATERAL].copy()
        x[LATERAL, :, :-1] = np.where(mask[:, 1:], -step[:, 1:], 1.0)
        x[LATERAL, :, :-1][~mask[:, :-1]] = 0.0
        # A pixel whose new neighbour was missing had been that neighbour's business: far.
        x[LATERAL, :, -1] = np.where(mask[:, -1], 1.0, 0.0)
        y[:, -1] = IGNORE
    if rng.random() < 0.25:
        x, y = head_down(x, y)
        mask = x[MASK] > 0.5
    scale = np.exp(rng.uniform(-0.25, 0.25)) if rng.random() < 0.7 else 1.0
    if scale != 1.0:
        x[RANGE] += mask * (0.5 * np.log2(scale))
        x[WIDTH] += mask * (0.25 * np.log2(scale))
        x[HEIGHT] = np.clip(x[HEIGHT] * scale, -1.0, 3.0)
        for plane in (LATERAL, VERTICAL, RISE, BULGE, SLANT, ROUGHNESS):
            s = x[plane]
            # s = d / (|d| + c) has d / c = s / (1 - |s|).
            d = s / np.maximum(1.0 - np.abs(s), 1e-3) * scale
            x[plane] = np.where(np.abs(s) > 0.998, s, d / (np.abs(d) + 1.0))
    drop = rng.random(mask.shape) < rng.choice([0.0, 0.003, 0.03])
    drop &= mask
    if drop.any():
        mask = mask & ~drop
        left = np.zeros_like(drop)
        left[:, :-1] = drop[:, 1:]
        below = np.zeros_like(drop)
        below[:-1] = drop[1:]
        x[LATERAL][left & mask] = 1.0
        x[VERTICAL][below & mask] = 1.0
        x[RISE][below & mask] = 0.0
        x[:, drop] = 0.0
        y = np.where(drop, IGNORE, y).astype(np.uint8)
    if rng.random() < 0.15:
        x[INTENSITY] = x[BRIGHTNESS] = -0.5 * mask
    else:
        # Of the whole scan, and of each class by itself: leaves and bark of other plants.
        own = np.exp(rng.uniform(-0.2, 0.2, len(CLASSES))) if rng.random() < 0.5 else np.ones(len(CLASSES))
        gain = (np.exp(rng.uniform(-0.4, 0.4)) * own)[np.where(y == IGNORE, OTHER, y)]
        for plane in (INTENSITY, BRIGHTNESS):
            x[plane] = np.clip((x[plane] + 0.5) * gain, 0.0, 2.0) * mask - 0.5 * mask
    if rng.random() < 0.1:
        x[HEIGHT] = 0.0
        x[UP] = 0.0
        x[SIDE] = 0.0
    return x, y


def batches(data, rng, steps, size, width):
    for _ in range(steps):
        xs, ys = [], []
        for _ in range(size):
            i = int(rng.integers(data.count))
            draw = rng.random()
            columns = (data.wood_columns if draw < 0.5 else
                       data.other_columns if draw < 0.8 else data.busy_columns)[i]
            if len(columns) and rng.random() < 0.95:
                start = int(rng.choice(columns)) - int(rng.integers(width))
            else:
                start = int(rng.integers(data.cols))
            x, y = augment(*data.crop(i, start, width), rng)
            xs.append(x)
            ys.append(y)
        yield torch.from_numpy(np.stack(xs)), torch.from_numpy(np.stack(ys).astype(np.int64))


def ahead(items, depth=4):
    """The same items, made by a thread of their own while the last one is worked on."""
    made = queue.Queue(depth)
    end = object()

    def make():
        for item in items:
            made.put(item)
        made.put(end)

    threading.Thread(target=make, daemon=True).start()
    while (item := made.get()) is not end:
        yield item


# ---------------------------------------------------------------------------------------------
# Losses and scores
# ---------------------------------------------------------------------------------------------
CLASS_WEIGHT = torch.tensor([0.6, 1.6, 1.0, 1.0])


FAR = 0.5 * np.log2(8.0 / 4.0)  # Plane RANGE at 8 m.


def fine_loss(logits, target, x):
    """Weighted cross-entropy and the soft intersection over union of wood, the score that counts."""
    ce = F.cross_entropy(logits, torch.where(target == IGNORE, -100, target),
                         weight=CLASS_WEIGHT.to(logits.device), reduction="none")
    valid = (target != IGNORE).float()
    wood = (target == WOOD).float()
    # Far returns are few, but what is found far away is found early: they count twice.
    weight = valid * (1.0 + 1.0 * (x[:, RANGE] > FAR))
    total = (weight * CLASS_WEIGHT.to(logits.device)[torch.where(target == IGNORE, 0, target)]).sum()
    p = logits.softmax(1)[:, WOOD] * valid
    both = (p * wood).sum()
    return ((weight * ce).sum() / total.clamp_min(1.0)
            + 0.5 * (1.0 - (both + 1.0) / (p.sum() + wood.sum() - both + 1.0)))


def coarse_loss(logits, target):
    """Cross-entropy against the class shares within each coarse cell."""
    shares = torch.stack([(target == k).float() for k in range(len(CLASSES))], 1)
    factor = (target.shape[1] // logits.shape[2], target.shape[2] // logits.shape[3])
    shares = F.avg_pool2d(shares, factor)
    total = shares.sum(1, keepdim=True)
    weight = CLASS_WEIGHT.to(logits.device).view(1, -1, 1, 1)
    ce = -(weight * shares * logits.log_softmax(1)).sum(1)
    return ce.sum() / (weight * shares).sum().clamp_min(1.0) + 0.0 * total.sum()


@torch.no_grad()
def predict(net, planes, margin=32):
    """Labels of a whole scan, closed across azimuth 0 like the C++ code does."""
    rows, cols = planes.shape[1:]
    width = -(-(cols + 2 * margin) // 64) * 64
    canvas = np.zeros((1, PLANES, rows, width), np.float32)
    canvas[0, :, :, :cols + 2 * margin] = planes[:, :, np.arange(-margin, cols + margin) % cols]
    device = next(net.parameters()).device
    logits = net(torch.from_numpy(canvas).to(device))[0, :, :, margin:margin + cols]
    return logits.argmax(0).cpu().numpy()


def evaluate(net, data, indices=None):
    """Scores per kind of scene and over all: wood IoU, accuracy, wood recall (and beyond 8 m)."""
    net.eval()
    sums = {}
    for i in (range(data.count) if indices is None else indices):
        planes = data.planes[i].astype(np.float32)
        label = predict(net, planes)
        truth = data.labels[i]
        valid = truth != IGNORE
        far = 4.0 * np.exp2(2.0 * planes[RANGE]) > 8.0
        wood, guess = (truth == WOOD) & valid, (label == WOOD) & valid
        row = np.array([(wood & guess).sum(), (wood | guess).sum(), ((label == truth) & valid).sum(),
                        valid.sum(), wood.sum(), (wood & guess & far).sum(), (wood & far).sum(),
                        guess.sum()], float)
        for key in ("all", data.scans[i]["kind"]):
            sums[key] = sums.get(key, 0) + row
    scores = {}
    for key, s in sums.items():
        def ratio(a, b):
            return round(float(s[a] / s[b]), 4) if s[b] > 0 else None
        scores[key] = {"wood_iou": ratio(0, 1), "accuracy": ratio(2, 3), "wood_recall": ratio(0, 4),
                       "wood_precision": ratio(0, 7), "wood_recall_beyond_8m": ratio(5, 6)}
    return scores


# ---------------------------------------------------------------------------------------------
# Training
# ---------------------------------------------------------------------------------------------
class Average:
    """Exponential moving average of the weights: less noise at the end of a short training."""

    def __init__(self, net, decay):
        self.decay, self.steps = decay, 0
        self.state = {k: v.detach().clone() for k, v in net.state_dict().items()}

    def update(self, net):
        self.steps += 1
        decay = min(self.decay, (1 + self.steps) / (10 + self.steps))
        for k, v in net.state_dict().items():
            if v.dtype.is_floating_point:
                self.state[k].mul_(decay).add_(v.detach(), alpha=1 - decay)
            else:
                self.state[k].copy_(v)


def bfloat16_is_faster(args, device):
    """Times both on a network thrown away; without hardware support bfloat16 is far slower."""
    if device.type != "cpu":
        return False
    seconds = []
    for enabled in (False, True):
        net = ErfNet(args.layers).to(memory_format=torch.channels_last)
        x = torch.randn(args.batch, PLANES, 16, args.width).to(memory_format=torch.channels_last)
        y = torch.randint(0, len(CLASSES), (args.batch, 16, args.width))
        times = []
        for _ in range(4):
            start = time.process_time()
            with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
                logits = net(x)
            fine_loss(logits.float(), y, x).backward()
            times.append(time.process_time() - start)
        seconds.append(min(times[1:]))
    return seconds[1] < 0.9 * seconds[0]


def freeze_encoder(net, frozen):
    for module in net.encoder_modules():
        module.requires_grad_(not frozen)
        if frozen:
            module.eval()


class Team:
    """Processes that train the same network side by side: each has a batch of its own, the gradients are averaged.

    On a CPU two processes of one thread each do nearly twice the work of one; two threads of one process do not, since
    the tensors of this network are small. The batch normalisations see the batch of their own process.
    """

    def __init__(self, rank, size, meeting):
        self.rank, self.size = rank, size
        if size > 1:
            torch.distributed.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=size)

    def average(self, parameters, rate):
        """Averages the gradients in place; returns the learning rate of the first process."""
        if self.size == 1:
            return rate
        parts = [p.grad for p in parameters if p.grad is not None]
        flat = torch.cat([g.reshape(-1).float() for g in parts]
                         + [torch.tensor([float(rate) * self.size if self.rank == 0 else 0.0])])
        torch.distributed.all_reduce(flat)
        flat /= self.size
        at = 0
        for grad in parts:
            grad.copy_(flat[at:at + grad.numel()].view_as(grad))
            at += grad.numel()
        return float(flat[-1])

    def part(self):
        """Waits for the others, so that none hangs up on one that is still talking."""
        if self.size > 1:
            torch.distributed.barrier()
            torch.distributed.destroy_process_group()

    def agree(self, yes):
        """What the first process says."""
        if self.size == 1:
            return yes
        answer = torch.tensor([float(yes)])
        torch.distributed.broadcast(answer, 0)
        return bool(answer.item())


def train(args):
    if args.processes == 1:
        train_member(0, args, None)
        return
    meeting = (args.data / f"processes_{os.getpid()}").resolve()
    try:
        torch.multiprocessing.spawn(train_member, (args, meeting), args.processes)
    finally:
        meeting.unlink(missing_ok=True)


def train_member(rank, args, meeting):
    torch.set_num_threads(max(1, args.threads // args.processes))
    torch.manual_seed(args.seed)
    team = Team(rank, args.processes, meeting)

    def say(text):
        if rank == 0:
            print(text, flush=True)

    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    args.device = "a GPU" if device.type == "cuda" else f"{args.threads} CPU core(s)"
    training, held_out = Dataset(finished(args.data, "train_*")), Dataset(finished(args.data, "held_out"))
    net = ErfNet(args.layers).to(device, memory_format=torch.channels_last)
    if args.bfloat16 is None:
        args.bfloat16 = team.agree(bfloat16_is_faster(args, device))
    say(f"training on {device.type} in {'bfloat16' if args.bfloat16 else 'float32'}")
    phases = [("encoder", 0 if args.init else args.encoder_epochs),
              ("decoder", 0 if args.init else args.decoder_epochs), ("joint", args.joint_epochs)]
    total = sum(n for _, n in phases)
    state = {"epoch": 0, "best": -1.0, "best_state": None, "log": [], "seconds": 0.0, "stale": 0}
    checkpoint = args.data / args.checkpoint
    optimizer = average = None
    if args.resume and checkpoint.exists():
        saved = torch.load(checkpoint, map_location=device)
        if saved["layers"] != args.layers:
            raise SystemExit("train_segmentation: the checkpoint is of another architecture")
        state = saved["state"]
        net.load_state_dict(saved["net"])
        say(f"resumed after epoch {state['epoch']} of {total}, best {state['best']:.4f}")
    else:
        saved = None
        if args.init:
            net = deepened(load_exported(args.init), args.layers)
            rng = np.random.default_rng([args.seed, 1 << 20])
            unfold(net, [x for x, _ in batches(training, rng, 30, args.batch, args.width)])
            net = net.to(device, memory_format=torch.channels_last)
    picture = list(range(0, held_out.count, max(1, held_out.count // args.held_out_scans)))
    while state["epoch"] < total:
        epoch = state["epoch"]
        begin = 0
        for phase, length in phases:
            if epoch < begin + length:
                break
            begin += length
        if epoch == begin or optimizer is None:
            freeze_encoder(net, phase == "decoder")
            parameters = [p for p in net.parameters() if p.requires_grad]
            optimizer = torch.optim.AdamW(parameters, lr=1e-3, weight_decay=1e-3)
            average = Average(net, 0.998)
            if saved is not None and epoch != begin:
                optimizer.load_state_dict(saved["optimizer"])
                average.state, average.steps = saved["average"], saved["average_steps"]
            saved = None
        # Data and drop-out of an epoch depend on the seed and its number only: resuming is exact.
        rng = np.random.default_rng([args.seed, epoch] + ([rank] if rank else []))
        torch.manual_seed(args.seed * 10007 + epoch + 1000003 * rank)
        peak = {"encoder": 2e-3, "decoder": 2e-3, "joint": args.joint_rate}[phase]
        net.train()
        freeze_encoder(net, phase == "decoder")
        if phase != "joint":
            state["joint_from"] = 0.0
        elif epoch == begin:
            state["joint_from"] = state["seconds"]
        started, losses = time.time(), []
        for step, (x, y) in enumerate(ahead(batches(training, rng, args.steps, args.batch,
                                                          args.width))):
            done = epoch - begin + step / args.steps
            warm = min(1.0, (done * args.steps + 1) / 100.0)
            progress = done / length
            if args.minutes and phase == "joint":
                # On a time budget the rate falls with the time that is used up.
                used = state["seconds"] + time.time() - started
                budget = 60.0 * args.minutes - state["joint_from"]
                progress = max(progress, min(1.0, (used - state["joint_from"]) / budget))
            rate = peak * warm * (0.5 + 0.5 * np.cos(np.pi * progress)) + 1e-5
            x, y = x.to(device, memory_format=torch.channels_last), y.to(device)
            with torch.autocast(device.type, torch.bfloat16, enabled=args.bfloat16):
                logits = net.coarse(x) if phase == "encoder" else net(x)
            logits = logits.float()
            loss = coarse_loss(logits, y) if phase == "encoder" else fine_loss(logits, y, x)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            rate = team.average(parameters, rate)
            for group in optimizer.param_groups:
                group["lr"] = rate
            nn.utils.clip_grad_norm_(net.parameters(), 5.0)
            optimizer.step()
            if rank == 0:
                average.update(net)
            losses.append(float(loss.detach()))
        state["seconds"] += time.time() - started
        state["epoch"] += 1
        line = {"epoch": state["epoch"], "phase": phase, "loss": round(float(np.mean(losses)), 4),
                "minutes": round(state["seconds"] / 60, 1)}
        out_of_time = team.agree(args.minutes and state["seconds"] > 60 * args.minutes)
        if rank == 0 and phase != "encoder" and (state["epoch"] % args.score_every == 0
                                                 or state["epoch"] == total or out_of_time):
            smooth = ErfNet(args.layers).to(device)
            smooth.load_state_dict(average.state)
            line.update(evaluate(smooth, held_out, picture)["all"])
            if line["wood_iou"] > state["best"]:
                state.update(best=line["wood_iou"], stale=0,
                             best_state={k: v.clone() for k, v in average.state.items()})
                # An interrupted training leaves its best weights behind.
                write_safetensors(args.output, *smooth.eval().export())
            elif phase == "joint":
                state["stale"] += 1
        state["log"].append(line)
        say(f"[{state['epoch']}/{total}] " + " ".join(f"{k}={v}" for k, v in line.items() if k != "epoch"))
        ended = state["epoch"] == begin + length
        if ended and phase == "encoder":
            # The other processes carry on from the average of the first.
            net.load_state_dict(average.state)
            if team.size > 1:
                for value in net.state_dict().values():
                    torch.distributed.broadcast(value, 0)
        if rank == 0:
            temporary = checkpoint.with_suffix(".tmp")
            torch.save({"layers": args.layers, "net": net.state_dict(), "state": state,
                        "optimizer": optimizer.state_dict(), "average": average.state,
                        "average_steps": average.steps}, temporary)
            os.replace(temporary, checkpoint)
        if out_of_time:
            say("the time is used up")
            break
        if not team.agree(state["stale"] < args.patience):
            break
    team.part()
    if rank != 0:
        return
    best = ErfNet(args.layers)
    best.load_state_dict(state["best_state"])
    best.eval()
    write_safetensors(args.output, *best.export())
    scores = evaluate(load_exported(args.output), held_out)
    write_card(args, training, held_out, best, state, scores)
    print(json.dumps(scores, indent=1))


def write_card(args, training, held_out, net, state, scores):
    parameters = sum(v.size for v in net.export()[0].values())
    kinds = sorted(k for k in scores if k != "all")

    def show(value):
        return "-" if value is None else f"{value:.4f}"

    columns = ["wood_iou", "accuracy", "wood_recall", "wood_precision", "wood_recall_beyond_8m"]
    table = ["| held-out scans | " + " | ".join(c.replace("_", " ") for c in columns) + " |",
             "|---" * (len(columns) + 1) + "|"]
    for key in ["all"] + kinds:
        table.append(f"| {key} | " + " | ".join(show(scores[key][c]) for c in columns) + " |")
    phases = {}
    for line in state["log"]:
        phases[line["phase"]] = phases.get(line["phase"], 0) + 1
    text = f"""# Model card: {args.output.name}

Wood, ground, leaf and other in a range image. Written by `scripts/train_segmentation.py`.

- Date: {datetime.date.today().isoformat()}
- Command: `scripts/train_segmentation.py {' '.join(args.command)}`
- Layers: `{args.layers}`
- Parameters: {parameters} (32-bit floats, batch normalisation folded), {args.output.stat().st_size / 1e6:.2f} MB
- Input: {PLANES} planes, see `include/dendro_slam/segmentation/network_input.h`
- Data: simulated only, {training.count} scans to train (scene seeds from {training.seeds[0]}), {held_out.count}
  held out (scene seeds from {held_out.seeds[0]}, other scenes), {training.rows} x {training.cols}, by `simulate_training_scans`
- Training: {', '.join(f'{n} epochs {p}' for p, n in phases.items())}, {args.steps} steps of {args.processes} x {args.batch} crops
  {training.rows} x {args.width} each; AdamW, cross-entropy and soft IoU of wood, averaged weights; seed {args.seed};
  {'bfloat16' if args.bfloat16 else 'float32'}, {state['seconds'] / 60:.0f} min on {args.device}
- Started from: {args.init or 'random numbers'}
- Augmentation: yaw (place of the crop), mirror, head down, range scale, drop-out, intensity gain (of the scan, and of
  each class) and off, ground unknown
- Early stopping: the weights with the best wood IoU on a part of the held-out scans ({state['best']:.4f})

## Scores per pixel, mixed pixels and all

{chr(10).join(table)}

## Limits

No real scan was used. Reflectivities are drawn at random, half of the scenes within what bark and leaves
reflect in the near infrared. The simulator's leaves are discs and its bark is smooth. Poles and posts
look like wood, and twigs thinner than the beam among leaves look like leaves.
"""
    args.output.with_suffix(".md").write_text(text)


def write_fixture(folder, seed=7):
    torch.manual_seed(seed)
    net = ErfNet(FIXTURE_LAYERS)
    for module in net.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.3)
            module.running_var.uniform_(0.5, 1.5)
            nn.init.uniform_(module.weight, 0.7, 1.3)
            nn.init.normal_(module.bias, 0, 0.2)
    net.eval()
    x = torch.randn(1, PLANES, 16, 64)
    with torch.no_grad():
        logits = net(x)
    write_safetensors(folder / "erfnet_fixture.safetensors", *net.export())
    write_safetensors(folder / "erfnet_fixture_io.safetensors",
                      {"input": x[0].numpy(), "logits": logits[0].numpy()})


def finished(folder, pattern):
    return [p.parent for p in folder.glob(pattern + "/meta.json")]


def simulate(args):
    """Simulates what is missing, a few folders at a time. Every folder has its own scene seeds."""
    program = PROGRAMS / "simulate_training_scans"
    jobs = [("held_out", args.test_scans, 900000)] if not finished(args.data, "held_out") else []
    if not finished(args.data, "train_*"):
        share = -(-args.train_scans // args.folders)
        jobs += [(f"train_{k}", share, 1000 + k * 100000) for k in range(args.folders)]
    if jobs and not program.exists():
        raise SystemExit("train_segmentation: build first (scripts/build simulate_training_scans)")
    running = []
    for name, count, seed in jobs:
        print(f"simulating {count} scans into {args.data / name}", flush=True)
        running.append(subprocess.Popen([str(program), "-o", str(args.data / name), "--scans",
                                         str(count), "--seed", str(seed)] + args.projector))
        if len(running) == args.threads:
            if running.pop(0).wait():
                raise SystemExit("train_segmentation: the simulation failed")
    if any(process.wait() for process in running):
        raise SystemExit("train_segmentation: the simulation failed")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--image", choices=["16x1800", "32x360"], default="16x1800",
                        help="a VLP-16's own, or the thesis'")
    parser.add_argument("--data", type=pathlib.Path,
                        help="folder of the simulated scans and the checkpoint")
    parser.add_argument("--output", type=pathlib.Path, help="default: config/models/")
    parser.add_argument("--train-scans", type=int, default=12000, help="1.2 MB each on the disk")
    parser.add_argument("--folders", type=int, default=15, help="that the training scans are spread over")
    parser.add_argument("--test-scans", type=int, default=192)
    parser.add_argument("--held-out-scans", type=int, default=40, help="scored during the training")
    parser.add_argument("--layers")
    parser.add_argument("--encoder-epochs", type=int, default=4)
    parser.add_argument("--decoder-epochs", type=int, default=4)
    parser.add_argument("--joint-epochs", type=int, default=300)
    parser.add_argument("--joint-rate", type=float, default=2e-3, help="peak learning rate of the joint step")
    parser.add_argument("--steps", type=int, default=200, help="per epoch")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--width", type=int, default=320, help="columns of a crop, a multiple of 16")
    parser.add_argument("--score-every", type=int, default=15, help="epochs")
    parser.add_argument("--patience", type=int, default=20, help="scores without a better one")
    parser.add_argument("--minutes", type=float, default=0,
                        help="of training at most, the learning rate falls accordingly; 0: no limit")
    parser.add_argument("--bfloat16", action=argparse.BooleanOptionalAction, default=None,
                        help="default: if it is faster on this CPU")
    parser.add_argument("--threads", type=int, default=max(1, os.cpu_count() or 1))
    parser.add_argument("--processes", type=int, help="that train side by side, each with a batch and its share of the "
                        "threads; default: one a thread without a GPU")
    parser.add_argument("--init", type=pathlib.Path, metavar="FILE",
                        help="go on from these weights in the joint step, with a new learning rate; "
                             "blocks nb they lack begin as ones that do nothing")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--checkpoint", default="checkpoint.pt")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--evaluate", type=pathlib.Path, metavar="FILE")
    parser.add_argument("--fixture", type=pathlib.Path, metavar="DIR")
    args = parser.parse_args()
    args.command = sys.argv[1:]
    native = args.image == "16x1800"
    suffix = "" if native else "_" + args.image
    args.data = args.data or ROOT / f"output/segmentation_data{suffix}"
    args.output = args.output or ROOT / f"config/models/erfnet_wood{suffix}.safetensors"
    args.layers = args.layers or (LAYERS if native else LAYERS_32X360)
    args.processes = args.processes or (1 if torch.cuda.is_available() else args.threads)
    args.projector = [] if native else ["--model", "uniform", "--rows", "32", "--cols", "360"]
    if args.fixture:
        write_fixture(args.fixture)
        return
    simulate(args)
    if args.evaluate:
        torch.set_num_threads(args.threads)
        print(json.dumps(evaluate(load_exported(args.evaluate), Dataset(finished(args.data, "held_out"))), indent=1))
        return
    train(args)


if __name__ == "__main__":
    main()
