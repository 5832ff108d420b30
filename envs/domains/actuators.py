"""What differs between a policy's command and what a robot does, as a part of the training domain."""

from envs.base import Env, Value


def with_actuators(env: Env) -> Env:
    """The task with actuators and sensors that differ between episodes, each effect uniform in a range.

    `env.actuators` names ranges. Other effects get: scale 0.7 to 1.4 for each command entry, bias -0.15 to 0.15 of the
    command range [-1, 1], rotation -0.3 to 0.3 rad (Cartesian commands only), latency 0 to 0.6 control periods, jitter
    0 to 0.1 control periods.
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
