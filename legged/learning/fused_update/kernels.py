"""Triton kernels of PPO's update. closed_form.py has the same formulas in torch.

Matrices lie in memory row by row. Their sizes are multiples of the tiles that a program computes, and padding holds zeros.
NaN passes through every kernel: comparisons select values so that a NaN operand remains in the result.
"""

import triton
import triton.language as tl

from legged.learning import closed_form

HALF_LOG_2PI = tl.constexpr(closed_form.HALF_LOG_2PI)


@triton.jit
def elu(x):
    return tl.where(x > 0.0, x, tl.exp(tl.where(x > 0.0, 0.0, x)) - 1.0)


@triton.jit
def clamp(x, low, high):
    return tl.where(x < low, low, tl.where(x > high, high, x))


@triton.jit
def factor_of(largest):
    """Return the power of two that brings a number `largest` into [16, 32)."""
    power = tl.where(largest > 0.0, 4.0 - tl.floor(tl.log2(largest)), 0.0)
    return tl.exp2(tl.where(power > 100.0, 100.0, power))


@triton.jit
def pack(source, order, columns, signs, shift, scale, to, samples, rows, WIDTH: tl.constexpr, PADDED: tl.constexpr,
         LOADED: tl.constexpr, IMAGES: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    """Write the inputs of a network in the order of the mini-batches to `to`, (x * signs - shift) * scale.

    A mini-batch has `rows` rows: `samples` rows of `source` (., WIDTH) that `order` names, their mirror images, which take x
    from `columns` (IMAGES, PADDED), and zeros. The columns beyond WIDTH are zeros too. LOADED is a power of two, at least
    PADDED.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row, batch = at % rows, at // rows
    image, inside = row // samples, row < samples * IMAGES
    sample = tl.load(order + batch * samples + row % samples, mask=inside, other=0)
    column = tl.arange(0, LOADED)
    real = column < WIDTH
    both = inside[:, None] & real[None, :]
    entry = image[:, None] * PADDED + column[None, :]
    value = tl.load(source + sample[:, None] * WIDTH + tl.load(columns + entry, mask=both, other=0), mask=both, other=0.0)
    value = value * tl.load(signs + entry, mask=both, other=0.0) - tl.load(shift + column, mask=real, other=0.0)[None, :]
    value = tl.where(both, value * tl.load(scale + column, mask=real, other=0.0)[None, :], 0.0)
    to += at.to(tl.int64)[:, None] * PADDED + column[None, :]
    tl.store(to, value.to(to.dtype.element_ty), mask=(column < PADDED)[None, :])


@triton.jit
def forward(h, weight, bias, unit, to, IN: tl.constexpr, OUT: tl.constexpr, ACTIVATED: tl.constexpr,
            ROWS: tl.constexpr, COLUMNS: tl.constexpr, DEPTH: tl.constexpr):  # fmt: skip
    """Write elu(h W^T unit + b) to `to` (rows, OUT); without elu if not ACTIVATED. One program per tile."""
    tiles: tl.constexpr = OUT // COLUMNS
    row = (tl.program_id(0) // tiles) * ROWS + tl.arange(0, ROWS)
    out = (tl.program_id(0) % tiles) * COLUMNS + tl.arange(0, COLUMNS)
    inner = tl.arange(0, DEPTH)
    left, right = h + row[:, None] * IN + inner[None, :], weight + out[:, None] * IN + inner[None, :]
    total = tl.zeros([ROWS, COLUMNS], tl.float32)
    for k in range(0, IN, DEPTH):
        total = tl.dot(tl.load(left + k), tl.load(right + k).T, total, input_precision="ieee")
    total = total * tl.load(unit) + tl.load(bias + out)[None, :]
    if ACTIVATED:
        total = elu(total)
    tl.store(to + row[:, None] * OUT + out[None, :], total.to(to.dtype.element_ty))


@triton.jit
def backward(d, weight, h, to, IN: tl.constexpr, OUT: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
             DEPTH: tl.constexpr):  # fmt: skip
    """Write d W * elu'(h) to `to` (rows, IN). `d` is (rows, OUT), `h` (rows, IN). One program per tile."""
    tiles: tl.constexpr = IN // COLUMNS
    row = (tl.program_id(0) // tiles) * ROWS + tl.arange(0, ROWS)
    out = (tl.program_id(0) % tiles) * COLUMNS + tl.arange(0, COLUMNS)
    inner = tl.arange(0, DEPTH)
    left, right = d + row[:, None] * OUT + inner[None, :], weight + inner[:, None] * IN + out[None, :]
    total = tl.zeros([ROWS, COLUMNS], tl.float32)
    for k in range(0, OUT, DEPTH):
        total = tl.dot(tl.load(left + k), tl.load(right + k * IN), total, input_precision="ieee")
    at = row[:, None] * IN + out[None, :]
    value = tl.load(h + at).to(tl.float32)
    tl.store(to + at, (total * tl.where(value > 0.0, 1.0, value + 1.0)).to(to.dtype.element_ty))


@triton.jit
def actor_loss(mean, order, actions, columns, signs, log_prob, advantage, old_mean, old_std, std, gradient, largest, sums,
               samples, clip, IMAGES: tl.constexpr, ACTIONS: tl.constexpr, PADDED: tl.constexpr,
               BLOCK: tl.constexpr):  # fmt: skip
    """Write the gradient of PPO's surrogate by the mean actions, times the number of rows, to `gradient` (rows, PADDED).

    Rows are the samples and then their mirror images. `order` (samples,) are the samples' rows in the rollout's `actions`,
    `log_prob`, `advantage` and `old_mean`. `old_std` is the same in all rows. `largest` becomes the largest |gradient|. A row
    of `sums` (., 4 + PADDED) gets a program's sums of: surrogate, KL(old || new) over the samples, square differences to the
    mirror image, a column of `critic_loss`, gradient by std (PADDED).
    """
    program = tl.program_id(0)
    row = program * BLOCK + tl.arange(0, BLOCK)
    column = tl.arange(0, PADDED)
    inside, real = row < samples * IMAGES, column < ACTIONS
    both = inside[:, None] & real[None, :]
    sample = tl.load(order + row % samples, mask=inside, other=0)
    entry = (row // samples)[:, None] * PADDED + column[None, :]
    mirrored, sign = tl.load(columns + entry, mask=both, other=0), tl.load(signs + entry, mask=both, other=0.0)
    action = tl.load(actions + sample[:, None] * ACTIONS + mirrored, mask=both, other=0.0) * sign
    at = row[:, None] * PADDED + column[None, :]
    m = tl.load(mean + at)
    deviation, then = tl.load(std + column, mask=real, other=1.0), tl.load(old_std + column, mask=real, other=1.0)
    inverse = 1.0 / deviation
    z = tl.where(both, (action - m) * inverse[None, :], 0.0)
    logs = tl.sum(tl.where(real, tl.log(deviation), 0.0), 0)
    density = -0.5 * tl.sum(z * z, 1) - logs - ACTIONS * HALF_LOG_2PI
    ratio = tl.exp(density - tl.load(log_prob + sample, mask=inside, other=0.0))
    gain = tl.load(advantage + sample, mask=inside, other=0.0)
    near = clamp(ratio, 1.0 - clip, 1.0 + clip)
    plain, clipped = -gain * ratio, -gain * near
    active = tl.where((ratio == near) | (plain > clipped) | (ratio != ratio), plain, 0.0)
    by_mean = tl.where(both, active[:, None] * z * inverse[None, :], 0.0)
    tl.store(gradient + at, by_mean)
    tl.atomic_max(largest, tl.max(tl.max(tl.abs(by_mean), 1), 0))
    before = tl.load(old_mean + sample[:, None] * ACTIONS + column[None, :], mask=both, other=0.0)
    moved = (then * then)[None, :] + (before - m) * (before - m)
    apart = tl.log(deviation / then)[None, :] + moved * (0.5 * inverse * inverse)[None, :] - 0.5
    own = both & (row < samples)[:, None]
    to = sums + program * (4 + PADDED)
    tl.store(to, tl.sum(tl.where(inside, tl.where(plain > clipped, plain, tl.where(plain != plain, plain, clipped)), 0.0), 0))
    tl.store(to + 1, tl.sum(tl.sum(tl.where(own, apart, 0.0), 1), 0))
    if IMAGES == 2:
        image = both & (row >= samples)[:, None]
        other = tl.load(mean + (row - samples)[:, None] * PADDED + mirrored, mask=image, other=0.0) * sign
        tl.store(to + 2, tl.sum(tl.sum(tl.where(image, (m - other) * (m - other), 0.0), 1), 0))
    by_std = tl.where(both, active[:, None] * (z * z - 1.0) * inverse[None, :], 0.0)
    tl.store(to + 4 + column, tl.sum(by_std, 0))


@triton.jit
def critic_loss(value, order, old_value, returns, gradient, largest, sums, samples, clip, coefficient, CLIPPED: tl.constexpr,
                IMAGES: tl.constexpr, PADDED: tl.constexpr, SUMS: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    """Write the gradient of `coefficient` * value loss by the values, times the number of rows, to column 0 of `gradient`.

    The other columns of `gradient` (rows, PADDED) become 0. A row of `sums` (., SUMS) gets a program's sum of the value loss
    in column 3. `order`, `samples` and `largest` are those of `actor_loss`.
    """
    program = tl.program_id(0)
    row = program * BLOCK + tl.arange(0, BLOCK)
    column = tl.arange(0, PADDED)
    inside = row < samples * IMAGES
    sample = tl.load(order + row % samples, mask=inside, other=0)
    found = tl.load(value + row * PADDED, mask=inside, other=0.0)
    wanted = tl.load(returns + sample, mask=inside, other=0.0)
    error = found - wanted
    loss, by_value = error * error, 2.0 * coefficient * error
    if CLIPPED:
        before = tl.load(old_value + sample, mask=inside, other=0.0)
        moved = found - before
        near = before + clamp(moved, -clip, clip) - wanted
        by_value = tl.where((tl.abs(moved) <= clip) | (loss > near * near) | (moved != moved), by_value, 0.0)
        loss = tl.where(loss > near * near, loss, tl.where(loss != loss, loss, near * near))
    by_value = tl.where(inside, by_value, 0.0)
    tl.store(gradient + row[:, None] * PADDED + column[None, :], tl.where(column[None, :] == 0, by_value[:, None], 0.0))
    tl.atomic_max(largest, tl.max(tl.abs(by_value), 0))
    tl.store(sums + program * SUMS + 3, tl.sum(tl.where(inside, loss, 0.0), 0))


@triton.jit
def scale(d, largest, to, BLOCK: tl.constexpr):
    """Write d, times the factor of its `largest` number, to `to`."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    tl.store(to + at, (tl.load(d + at) * factor_of(tl.load(largest))).to(to.dtype.element_ty))


@triton.jit
def weights(d, h, unit, to, bias, part, rows, rows_each, IN: tl.constexpr, OUT: tl.constexpr, ROWS: tl.constexpr,
            COLUMNS: tl.constexpr, DEPTH: tl.constexpr):  # fmt: skip
    """Write partial sums of d^T h * unit to `to`, and of the rows of d to `bias`. `d` is (rows, OUT), `h` (rows, IN).

    The first axis of the grid is the tile of the weights, the second the part of the rows. A part has `rows_each` rows; their
    sums are `part` numbers apart.

    The rows of d are summed by a product with ones. If the loaded d had another use than products, Triton 3.6 would give it
    too few buffers, and loads would overwrite what a product still reads.
    """
    tiles: tl.constexpr = IN // COLUMNS
    out = (tl.program_id(0) // tiles) * ROWS + tl.arange(0, ROWS)
    into = (tl.program_id(0) % tiles) * COLUMNS + tl.arange(0, COLUMNS)
    start = tl.program_id(1) * rows_each
    row = start + tl.arange(0, DEPTH)
    left, right = d + row[:, None] * OUT + out[None, :], h + row[:, None] * IN + into[None, :]
    total, sums = tl.zeros([ROWS, COLUMNS], tl.float32), tl.zeros([ROWS, 16], tl.float32)
    ones = tl.full([DEPTH, 16], 1.0, h.dtype.element_ty)
    for _ in range(start, tl.where(start + rows_each < rows, start + rows_each, rows), DEPTH):
        gradient = tl.load(left)
        total = tl.dot(gradient.T, tl.load(right), total, input_precision="ieee")
        sums = tl.dot(gradient.T, ones, sums, input_precision="ieee")
        left += DEPTH * OUT
        right += DEPTH * IN
    offset = tl.program_id(1) * part
    tl.store(to + offset + out[:, None] * IN + into[None, :], total * tl.load(unit))
    if tl.program_id(0) % tiles == 0:
        tl.store(bias + offset + out, tl.sum(sums, 1) / 16.0)


@triton.jit
def reduce(parts, counts, to, squares, largest, share, part, BLOCK: tl.constexpr):
    """Write the sum of parts, times `share` and without the factor of `largest`, to `to`. `counts` has the number of parts of
    every BLOCK numbers.

    Parts are `part` numbers apart. Each program writes the sum of the squares of its BLOCK numbers to `squares`.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    total = tl.zeros([BLOCK], tl.float32)
    for _ in range(0, tl.load(counts + tl.program_id(0))):
        total += tl.load(parts + at)
        parts += part
    total *= share / factor_of(tl.load(largest))
    tl.store(to + at, total)
    tl.store(squares + tl.program_id(0), tl.sum(total * total, 0))


@triton.jit
def settle(totals, squares, largest, std, std_gradient, rate, steps, scalars, losses, rows, samples, entropy_coef, desired_kl,
           lowest_rate, highest_rate, rate_step, most_norm, log_decay_1, log_decay_2, actor_squares, all_squares,
           ADAPTIVE: tl.constexpr, CRITIC_ALONE: tl.constexpr, IMAGES: tl.constexpr, ACTIONS: tl.constexpr,
           PADDED: tl.constexpr, SQUARES: tl.constexpr):  # fmt: skip
    """Decide on the gradient step. One program.

    It turns `totals` (4 + PADDED), sums of the losses, into means, and completes the gradient by std. It adapts the learning
    `rate`. Unless a gradient or the value loss is NaN or infinite, it counts the `steps` of actor and critic and adds the
    losses to `losses`. `scalars` (2, 4) get, for actor and critic: the factor that clips the gradient, the corrections
    1 - decay^step of both moments, and 1 if the step is taken, else 0.
    """
    column = tl.arange(0, PADDED)
    real = column < ACTIONS
    surrogate, kl, value = tl.load(totals) / rows, tl.load(totals + 1) / samples, tl.load(totals + 3) / rows
    deviation = tl.load(std + column, mask=real, other=1.0)
    entropy = tl.sum(tl.where(real, tl.log(deviation) + (0.5 + HALF_LOG_2PI), 0.0), 0)
    by_std = tl.where(real, tl.load(totals + 4 + column) / rows - entropy_coef / deviation, 0.0)
    tl.store(std_gradient + column, by_std)

    at = tl.arange(0, SQUARES)
    each = tl.load(squares + at, mask=at < all_squares, other=0.0)
    of_actor = tl.sqrt(tl.sum(tl.where(at < actor_squares, each, 0.0), 0) + tl.sum(by_std * by_std, 0))
    of_critic = tl.sqrt(tl.sum(tl.where(at < actor_squares, 0.0, each), 0))
    checked = value + of_critic
    if not CRITIC_ALONE:
        checked += of_actor
    taken = tl.where(checked < float("inf"), 1.0, 0.0)

    old = tl.load(rate)
    if ADAPTIVE and not CRITIC_ALONE:
        slower, faster = old / rate_step, old * rate_step
        slower = tl.where(slower < lowest_rate, lowest_rate, slower)
        faster = tl.where(faster > highest_rate, highest_rate, faster)
        new = tl.where((kl < 0.5 * desired_kl) & (kl > 0.0), faster, old)
        tl.store(rate, tl.where(kl > 2.0 * desired_kl, slower, new))

    for network in tl.static_range(2):
        moves = taken
        norm = of_critic
        if network == 0:
            norm = of_actor
            if CRITIC_ALONE:
                moves = 0.0 * taken
        step = tl.load(steps + network) + moves
        tl.store(steps + network, step)
        clip = most_norm / (norm + 1e-6)
        to = scalars + 4 * network
        tl.store(to, tl.where(clip > 1.0, 1.0, clip))
        tl.store(to + 1, (1.0 - tl.exp(step.to(tl.float64) * log_decay_1)).to(tl.float32))
        tl.store(to + 2, (1.0 - tl.exp(step.to(tl.float64) * log_decay_2)).to(tl.float32))
        tl.store(to + 3, moves)
        tl.store(largest + 4 * network, 0.0)

    add(losses, value, taken)
    add(losses + 1, surrogate, taken)
    add(losses + 2, entropy, taken)
    add(losses + 3, kl, taken)
    if IMAGES == 2:
        add(losses + 4, tl.load(totals + 2) / (samples * ACTIONS), taken)
    add(losses + 3 + IMAGES, taken, taken)


@triton.jit
def add(to, number, taken):
    """Add `number` to the number at `to` if `taken` is 1."""
    tl.store(to, tl.load(to) + tl.where(taken > 0.0, number, 0.0))


@triton.jit
def adam(parameters, first, second, shadow, gradient, rate, scalars, actor_end, decay_1, decay_2, epsilon,
         BLOCK: tl.constexpr):  # fmt: skip
    """Take a step of Adam with the `scalars` of `settle`. The first `actor_end` parameters are the actor's. `shadow` gets a
    copy of the parameters.
    """
    start = tl.program_id(0) * BLOCK
    at = start + tl.arange(0, BLOCK)
    own = scalars + tl.where(start < actor_end, 0, 4)
    if tl.load(own + 3) > 0.0:
        g = tl.load(gradient + at) * tl.load(own)
        m, v = tl.load(first + at), tl.load(second + at)
        m += (1.0 - decay_1) * (g - m)
        v = decay_2 * v + (1.0 - decay_2) * g * g
        new = tl.load(parameters + at) - tl.load(rate) / tl.load(own + 1) * m / (tl.sqrt(v / tl.load(own + 2)) + epsilon)
        tl.store(first + at, m)
        tl.store(second + at, v)
        tl.store(parameters + at, new)
        tl.store(shadow + at, new.to(shadow.dtype.element_ty))
