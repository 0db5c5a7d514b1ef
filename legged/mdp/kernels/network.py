"""Learned actuators in one launch per physics step. legged/mdp/actuators/network.py has the description and the torch code.

Each thread computes one joint of one robot. The network's units lie in a column of `scratch`, so that neighbouring threads
read adjacent numbers.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def sigmoid(x: float) -> float:
    """Return the logistic function."""
    return 1.0 / (1.0 + wp.exp(-x))


@wp.kernel
def run_mlp(
    error: wp.array2d[float],
    dof_vel: wp.array2d[float],
    position_scale: float,
    velocity_scale: float,
    torque_scale: float,
    every: int,
    samples: int,
    weights: wp.array[float],
    widths: wp.array[int],
    state: wp.array4d[float],
    scratch: wp.array3d[float],
    torques: wp.array2d[float],
):
    """Run the MLP (`ActuatorNetwork.torques`). One thread per robot and joint. The weights (out, in) of each layer precede
    its biases.
    """
    robot, joint = wp.tid()
    row = robot * error.shape[1] + joint
    for back in range(1, state.shape[1]):
        k = state.shape[1] - back
        for of in range(2):
            state[robot, k, of, joint] = state[robot, k - 1, of, joint]
    state[robot, 0, 0, joint] = position_scale * error[robot, joint]
    state[robot, 0, 1, joint] = velocity_scale * dof_vel[robot, joint]
    for i in range(samples):
        scratch[0, i, row] = state[robot, i * every, 0, joint]
        scratch[0, samples + i, row] = state[robot, i * every, 1, joint]
    at = wp.int32(0)
    side = wp.int32(0)
    layers = widths.shape[0] - 1
    for layer in range(layers):
        inputs, outputs = widths[layer], widths[layer + 1]
        for unit in range(outputs):
            total = weights[at + inputs * outputs + unit]
            for i in range(inputs):
                total += weights[at + unit * inputs + i] * scratch[side, i, row]
            if layer < layers - 1:
                total = total / (1.0 + wp.abs(total))
            scratch[1 - side, unit, row] = total
        at += (inputs + 1) * outputs
        side = 1 - side
    torques[robot, joint] = torque_scale * scratch[side, 0, row]


@wp.kernel
def run_lstm(
    error: wp.array2d[float],
    dof_vel: wp.array2d[float],
    position_scale: float,
    velocity_scale: float,
    torque_scale: float,
    weights: wp.array[float],
    widths: wp.array[int],
    state: wp.array4d[float],
    scratch: wp.array3d[float],
    torques: wp.array2d[float],
):
    """Run the LSTM (`ActuatorNetwork.torques`). One thread per robot and joint. For each layer, `weights` holds the weights
    of inputs (4 out, in), the weights of hidden units (4 out, out), and the biases (4 out,), each in the order of the gates
    i, f, g, o. Even rows of `state` hold hidden states, odd rows hold cell states.
    """
    robot, joint = wp.tid()
    row = robot * error.shape[1] + joint
    scratch[0, 0, row] = position_scale * error[robot, joint]
    scratch[0, 1, row] = velocity_scale * dof_vel[robot, joint]
    at = wp.int32(0)
    side = wp.int32(0)
    cells = widths.shape[0] - 2
    for cell in range(cells):
        inputs, units = widths[cell], widths[cell + 1]
        of_hidden = at + 4 * units * inputs
        of_bias = of_hidden + 4 * units * units
        for unit in range(units):
            gates = wp.vec4(0.0, 0.0, 0.0, 0.0)
            for gate in range(4):
                line = gate * units + unit
                total = weights[of_bias + line]
                for i in range(inputs):
                    total += weights[at + line * inputs + i] * scratch[side, i, row]
                for i in range(units):
                    total += weights[of_hidden + line * units + i] * state[robot, 2 * cell, i, joint]
                gates[gate] = total
            kept = sigmoid(gates[1]) * state[robot, 2 * cell + 1, unit, joint] + sigmoid(gates[0]) * wp.tanh(gates[2])
            state[robot, 2 * cell + 1, unit, joint] = kept
            scratch[1 - side, unit, row] = sigmoid(gates[3]) * wp.tanh(kept)
        side = 1 - side
        for unit in range(units):
            state[robot, 2 * cell, unit, joint] = scratch[side, unit, row]
        at = of_bias + 4 * units
    last = widths[cells]
    total = weights[at + last]
    for i in range(last):
        total += weights[at + i] * scratch[side, i, row]
    torques[robot, joint] = torque_scale * total
