"""The simulator's ground, for the height above it at which a true stem is to be measured."""

import math

WAVES = 5
MASK = (1 << 64) - 1
GAMMA = 0x9E3779B97F4A7C15


def _mix(z):
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK
    return z ^ (z >> 31)


class _CounterRng:
    """SplitMix64 from a hash of the key, as the simulator's."""

    def __init__(self, seed, a, b):
        self.state = _mix((_mix((_mix((seed + GAMMA) & MASK) + a) & MASK) + b) & MASK)

    def uniform(self):
        self.state = (self.state + GAMMA) & MASK
        return (_mix(self.state) >> 11) * 2.0 ** -53


def ground_height(ground, x, y):
    """Height [m] of a scene's `ground` at a place, or None where there is none.

    Rough ground is a sum of five plane waves whose directions and phases come from its seed.
    """
    kind = (ground or {}).get("type", "none")
    if kind == "none":
        return None
    z = float(ground.get("z", 0.0))
    if kind != "rough":
        return z
    wavelength, waves = float(ground["wavelength_m"]), []
    for i in range(WAVES):
        rng = _CounterRng(int(ground["seed"]), i, 0x6704)
        direction = 2.0 * math.pi * rng.uniform()
        phase = 2.0 * math.pi * rng.uniform()
        waves.append((wavelength, 2.0 * math.pi / wavelength, direction, phase))
        wavelength *= 0.55
    scale = float(ground["amplitude_m"]) / sum(w for w, _, _, _ in waves)
    return z + scale * sum(w * math.sin(k * (math.cos(d) * x + math.sin(d) * y) + phase) for w, k, d, phase in waves)
