"""What differs between a policy's command and what a robot does, as a part of the training domain."""

from envs.base import Env, Value


def with_actuators(env: Env) -> Env:
    """The task in a simulator whose actuators and sensors also differ between episodes, uniform in ranges.

    The ranges are `env.actuators`, and for effects that it does not name: scale 0.7 to 1.4 of each command, bias up to
    0.15, rotation up to 0.3 rad of Cartesian commands, latency up to 0.6 control periods with jitter up to 0.1.
    """
    n, period = env.act_dim, env.control_dt
    ranges: dict[str, Value] = {
        "action_scale": [[0.7] * n, [1.4] * n],
        "action_bias": [[-0.15] * n, [0.15] * n],
        "action_rotation": [-0.3, 0.3] if env.cartesian else 0.0,
        "latency": [0.0, 0.6 * period],
        "latency_jitter": [0.0, 0.1 * period],
    }
    return env._replace(training={**env.training, **ranges, **env.actuators})
