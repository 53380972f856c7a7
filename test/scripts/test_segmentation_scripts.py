"""The training script and the C++ network: the same logits, and a training that can be interrupted."""
import argparse
import json
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

pytest.importorskip("torch", reason="python3-torch is missing; scripts/setup installs it")
import benchmark_segmentation  # noqa: E402
import train_segmentation as training  # noqa: E402


@pytest.mark.parametrize("rows, cols", [(16, 1800), (32, 360)])
def test_shipped_weights_give_what_pytorch_gives(rows, cols):
    result = benchmark_segmentation.agreement(
        argparse.Namespace(weights=None, agreement=4, rows=rows, cols=cols))
    assert result["largest_logit"] > 1.0  # The comparison is of something.
    assert result["largest_logit_difference"] < 2e-3
    assert result["same_label"] >= 0.9999


def test_training_from_nothing_and_resumed(tmp_path):
    def run(*more):
        return subprocess.run(
            [sys.executable, str(ROOT / "scripts/train_segmentation.py"), "--data", str(tmp_path / "data"),
             "--output", str(tmp_path / "weights.safetensors"), "--threads", "1", "--no-bfloat16",
             "--train-scans", "4", "--folders", "1", "--test-scans", "2", "--encoder-epochs", "1",
             "--decoder-epochs", "1", "--steps", "2", "--batch", "2", "--width", "64",
             "--score-every", "1", *more],
            check=True, capture_output=True, text=True).stdout

    first = run("--joint-epochs", "1")
    assert "[3/3] phase=joint" in first
    scores = json.loads(first[first.index("{"):])
    assert set(scores) == {"all", "leafy"}  # The first two held-out scans are of one scene.
    resumed = run("--joint-epochs", "2", "--resume")
    assert "resumed after epoch 3 of 4" in resumed and "[4/4] phase=joint" in resumed
    tensors, metadata = training.read_safetensors(tmp_path / "weights.safetensors")
    assert metadata["layers"] == training.LAYERS and len(tensors) > 20
    card = (tmp_path / "weights.md").read_text()
    assert "4 scans to train" in card and "2 epochs joint" in card
    # Exported weights are trained on in the joint step alone.
    more = run("--joint-epochs", "1", "--init", str(tmp_path / "weights.safetensors"))
    assert "[1/1] phase=joint" in more and "phase=encoder" not in more


def test_unfolded_weights_compute_what_the_exported_ones_do():
    import torch
    net = training.load_exported(ROOT / "config/models/erfnet_wood.safetensors")
    torch.manual_seed(3)
    inputs = [torch.randn(2, training.PLANES, 16, 64) for _ in range(3)]
    with torch.no_grad():
        expected = net(inputs[0])
        training.unfold(net, inputs)
        norm = net.layers[0].bn
        seen = torch.cat([net.layers[0].conv(x) for x in inputs])
        assert torch.allclose(norm.running_mean, seen.mean((0, 2, 3)), atol=1e-4)
        assert torch.allclose(net(inputs[0]), expected, atol=1e-3 * float(expected.abs().max()))


def test_added_blocks_change_nothing_until_they_are_trained():
    import torch
    net = training.ErfNet("stem:16:3x5:1x2 push down:32:2x2 nb:1x2 grow:16:1x1:2x2 add last:4:1x1:1x2").eval()
    deeper = training.deepened(net, "stem:16:3x5:1x2 push down:32:2x2 nb:1x1 nb:1x2 nb:1x4 "
                                    "grow:16:1x1:2x2 add last:4:1x1:1x2")
    x = torch.randn(1, training.PLANES, 16, 64)
    with torch.no_grad():
        assert torch.allclose(deeper(x), net(x), atol=1e-5)
    # They are not lost for the training either.
    deeper.train()(x).square().sum().backward()
    assert float(deeper.layers[3].bn2.weight.grad.abs().max()) > 0.0
    with pytest.raises(SystemExit):
        training.deepened(net, net.spec.replace("down:32", "down:24"))


def test_head_down_steps_point_to_the_row_that_is_next():
    import numpy as np
    rng = np.random.default_rng(5)
    mask = rng.random((16, 40)) < 0.8
    distance, z = rng.uniform(1.0, 9.0, (16, 40)), rng.uniform(-1.0, 1.0, (16, 40))

    def planes(mask, distance, z):
        """The planes that depend on the next row, from their definition in network_input.h."""
        x = np.zeros((training.PLANES, 16, 40))
        for row, col in zip(*np.nonzero(mask)):
            x[training.MASK, row, col] = x[training.VERTICAL, row, col] = 1.0
            if row + 1 < 16 and mask[row + 1, col]:
                for plane, value in ((training.VERTICAL, distance), (training.RISE, z)):
                    d = value[row + 1, col] - value[row, col]
                    x[plane, row, col] = d / (abs(d) + 0.2)
        return x

    y = rng.integers(0, 4, (16, 40)).astype(np.uint8)
    flipped, labels = training.head_down(planes(mask, distance, z), y)
    # Head down the sensor's z points the other way.
    expected = planes(mask[::-1], distance[::-1], -z[::-1])
    assert np.allclose(flipped, expected)
    assert (labels == y[::-1]).all()
