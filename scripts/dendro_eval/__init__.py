"""Scores, figures and exports of dendro_slam maps. Needs numpy, scipy, yaml and matplotlib."""
