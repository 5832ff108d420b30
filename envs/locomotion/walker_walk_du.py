"""Walker-walk with the masses of Du et al. 2021: all links have one mass, 10.3 to 30.9 kg in training, 10.3 in reality.

The other way round than in SGFT's released code, whose real walker is the heavier one: `envs.locomotion.walker_walk`.
"""

from envs.locomotion import walker_walk

SCENE = walker_walk.scene("walker-walk-du", mass=(2.0, 1.0, 3.0), even=1.0)
