"""Cheetah-run with the masses of Du et al. 2021: links have one, 6.4 to 19.1 kg in training, 6.4 in reality."""

from envs.locomotion import cheetah_run

SCENE = cheetah_run.scene("cheetah-run-du", mass=(2.0, 1.0, 3.0), even=1.0)
