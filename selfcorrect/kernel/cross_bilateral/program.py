"""The kernel as a program in Triton's language: one pixel a thread, forward and backward in one sweep over its window.

GRADIENTS.md derives what stands here, with the arithmetic that decided for one sweep; reference.py is the readable
form. Weights and sums are float32, nothing is added up by atomics: the same input gives the same bits.

Buffers are seen as TERMS, a tuple each in the order of the bandwidths γ: first plane, channels, place of its scale β
among those that have one or −1, whether Eq. 11 takes the logarithm of its distance. The first is y.
"""

import triton
import triton.language as tl

__all__ = ["BACKWARD", "FORWARD", "LOSS", "program"]

_EPSILON = tl.constexpr(1e-4)  # ε of Eq. 11; the published code adds the same to τ
_LOG2_E = tl.constexpr(1.4426950408889634)

FORWARD = tl.constexpr(0)  # writes g
BACKWARD = tl.constexpr(1)  # reads ∂L/∂g, writes the gradient of the raw heads
LOSS = tl.constexpr(2)  # reads target and weight, writes the gradient and the sum of Eq. 8 over the program's pixels


@triton.jit
def _load(pointer, at, stride, COUNT: tl.constexpr):
    """A tuple of COUNT planes' values."""
    values = ()
    for k in tl.static_range(COUNT):
        values = values + (tl.load(pointer + (at + k * stride)),)
    return values


@triton.jit
def _difference(a, b):
    values = ()
    for k in tl.static_range(len(a)):
        values = values + (a[k] - b[k],)
    return values


@triton.jit
def _plus(sums, factor, values):
    """sums + factor · values."""
    new = ()
    for k in tl.static_range(len(values)):
        new = new + (sums[k] + factor * values[k],)
    return new


@triton.jit
def _zeros(like, COUNT: tl.constexpr):
    values = ()
    for _ in tl.static_range(COUNT):
        values = values + (tl.zeros_like(like),)
    return values


@triton.jit
def _squared(d):
    total = d[0] * d[0]
    for k in tl.static_range(1, len(d)):
        total += d[k] * d[k]
    return total


@triton.jit
def _softplus(x):
    return tl.maximum(x, 0.0) + tl.log(1.0 + tl.exp(-tl.abs(x)))


@triton.jit
def _sigmoid(x):
    e = tl.exp(-tl.abs(x))
    return tl.where(x < 0, e, 1.0) / (1.0 + e)


@triton.jit
def _tanh(x):
    e = tl.exp(-2.0 * tl.abs(x))
    return tl.where(x < 0, -1.0, 1.0) * (1.0 - e) / (1.0 + e)


@triton.jit
def _distances(d, TERMS: tl.constexpr):
    """Eq. 11's D of every term, logarithms of base 2."""
    found = ()
    for m in tl.static_range(len(TERMS)):
        squared = _squared(d[m])
        if TERMS[m][3]:
            squared = tl.log2(1.0 + squared)
        found = found + (squared,)
    return found


@triton.jit
def _exponent(distances, inverse):
    total = distances[0] * inverse[0]
    for m in tl.static_range(1, len(distances)):
        total += distances[m] * inverse[m]
    return total


@triton.jit
def _combined(d, beta, TERMS: tl.constexpr):
    """h_i − y_c: Eq. 10's bracket, less y at the centre."""
    h = (-d[0][0], -d[0][1], -d[0][2])
    for m in tl.static_range(1, len(TERMS)):
        if TERMS[m][2] >= 0:
            new = ()
            for k in tl.static_range(3):
                new = new + (h[k] + beta[3 * TERMS[m][2] + k] * d[m][k],)
            h = new
    return h


@triton.jit
def _raised(sums, w, d, TERMS: tl.constexpr):
    """The sums of w (f_c − f_i) over the buffers that have a scale β."""
    new = ()
    for m in tl.static_range(len(TERMS)):
        if TERMS[m][2] >= 0:
            for k in tl.static_range(3):
                new = new + (sums[3 * TERMS[m][2] + k] + w * d[m][k],)
    return new


@triton.jit
def _activated(heads, stride, like, TERMS: tl.constexpr, BETAS: tl.constexpr, EVERY: tl.constexpr, EQ3: tl.constexpr):
    """β, the factors of Eq. 11's exponent, and the centre's weight."""
    beta = ()
    for k in tl.static_range(BETAS):
        if EQ3:
            beta = beta + (tl.full(like.shape, 1.0 if k < 3 else 0.0, tl.float32),)
        else:
            beta = beta + (_tanh(tl.load(heads + k * stride)),)
    gammas = heads + (0 if EQ3 else BETAS) * stride
    inverse = ()  # negative and for exp2, so that each term is one FMA
    for m in tl.static_range(len(TERMS)):
        gamma = _softplus(tl.load(gammas + m * stride))
        inverse = inverse + ((-1.0 if TERMS[m][3] else -_LOG2_E) / (gamma * gamma + _EPSILON),)
    # Where only every n-th tap is taken, the centre counts for an n-th too.
    return beta, inverse, (_softplus(tl.load(gammas + len(TERMS) * stride)) + _EPSILON) / EVERY


@triton.jit
def _sweep(
    planes,
    centre,
    plane_stride,
    row_stride,
    activations,
    GRADIENT: tl.constexpr,
    TERMS: tl.constexpr,
    BETAS: tl.constexpr,
    WINDOW: tl.constexpr,
    EVERY: tl.constexpr,
):
    """Sums over the window: w, w (h − y_c); with GRADIENT w (f_c − f_i), w D and w D (h − y_c) of every term."""
    beta, inverse, centre_weight = activations
    c = ()
    for m in tl.static_range(len(TERMS)):
        c = c + (_load(planes + TERMS[m][0] * plane_stride, centre, plane_stride, TERMS[m][1]),)
    # All sums are of differences to the centre: exact where the window is constant.
    w_sum = tl.zeros_like(centre_weight)
    h_sum = _zeros(w_sum, 3)
    deviation = _zeros(w_sum, BETAS if GRADIENT else 0)
    distance = _zeros(w_sum, len(TERMS) if GRADIENT else 0)
    moment = _zeros(w_sum, 3 * len(TERMS) if GRADIENT else 0)
    radius: tl.constexpr = WINDOW // 2
    slope: tl.constexpr = 1 if EVERY < 4 else 2  # a lattice that has the centre and is spread over all rows
    for dy in range(-radius, radius + 1):
        for dx in range(-radius + (slope * dy + radius + EVERY * WINDOW) % EVERY, radius + 1, EVERY):
            at = centre + (dy * row_stride + dx)
            d = ()
            for m in tl.static_range(len(TERMS)):
                i = _load(planes + TERMS[m][0] * plane_stride, at, plane_stride, TERMS[m][1])
                d = d + (_difference(c[m], i),)
            distances = _distances(d, TERMS)
            w = tl.where((dy == 0) & (dx == 0), centre_weight, tl.exp2(_exponent(distances, inverse)))
            h = _combined(d, beta, TERMS)
            w_sum += w
            h_sum = _plus(h_sum, w, h)
            if GRADIENT:
                deviation = _raised(deviation, w, d, TERMS)
                distance = _plus(distance, w, distances)
                for_each = ()
                for m in tl.static_range(len(TERMS)):
                    wd = w * distances[m]
                    for k in tl.static_range(3):
                        for_each = for_each + (moment[3 * m + k] + wd * h[k],)
                moment = for_each
    return w_sum, h_sum, deviation, distance, moment


@triton.jit
def _scatter(
    to,
    to_stride,
    heads,
    heads_stride,
    inside,
    upstream,
    beta,
    sums,
    TERMS: tl.constexpr,
    BETAS: tl.constexpr,
    EVERY: tl.constexpr,
    EQ3: tl.constexpr,
):
    """The raw heads' gradients from ∂L/∂g and the sums, each written by the one thread that has the pixel."""
    w_sum, h_sum, deviation, distance, moment = sums
    w_inverse = 1.0 / w_sum
    used: tl.constexpr = 0 if EQ3 else BETAS
    for k in tl.static_range(used):
        value = upstream[k % 3] * deviation[k] * w_inverse * (1.0 - beta[k] * beta[k])
        tl.store(to + k * to_stride, value, mask=inside)
    change = (h_sum[0] * w_inverse, h_sum[1] * w_inverse, h_sum[2] * w_inverse)
    for m in tl.static_range(len(TERMS)):
        t = tl.zeros_like(w_sum)  # Σ w t D of GRADIENTS.md
        for k in tl.static_range(3):
            t += upstream[k] * (moment[3 * m + k] - change[k] * distance[m])
        x = tl.load(heads + (used + m) * heads_stride)
        gamma = _softplus(x)
        s = 1.0 / (gamma * gamma + _EPSILON)
        unit = 1.0 / _LOG2_E if TERMS[m][3] else 1.0  # the logarithms are of base 2
        value = 2.0 * unit * t * w_inverse * gamma * s * s * _sigmoid(x)
        tl.store(to + (used + m) * to_stride, value, mask=inside)
    t = upstream[0] * change[0] + upstream[1] * change[1] + upstream[2] * change[2]
    slope = _sigmoid(tl.load(heads + (used + len(TERMS)) * heads_stride)) / EVERY
    tl.store(to + (used + len(TERMS)) * to_stride, -t * w_inverse * slope, mask=inside)  # h_c = y_c


@triton.jit(
    do_not_specialize=[
        "plane_stride",
        "row_stride",
        "raw_patch",
        "raw_head",
        "raw_row",
        "raw_column",
        "gradient_patch",
        "gradient_head",
        "gradient_row",
        "gradient_column",
        "target_plane",
        "height",
        "width",
    ]
)
def program(
    planes,
    raw,
    corners,
    image,
    gradient,
    target,
    weight,
    losses,
    plane_stride,
    row_stride,
    raw_patch,
    raw_head,
    raw_row,
    raw_column,
    gradient_patch,
    gradient_head,
    gradient_row,
    gradient_column,
    target_plane,
    height,
    width,
    MODE: tl.constexpr,
    TERMS: tl.constexpr,
    BETAS: tl.constexpr,
    WINDOW: tl.constexpr,
    EVERY: tl.constexpr,
    EQ3: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
):
    """ROWS × COLUMNS pixels of one patch; the grid is (tiles of a patch, patches).

    ``image`` is g, or ∂L/∂g where MODE is BACKWARD, (N, 3, height, width); ``losses`` has a value for each program.
    What a mode does not use is None. Sizes and strides are never built in: a frame of another size compiles nothing.
    """
    patch = tl.program_id(1).to(tl.int64)
    across = tl.cdiv(width, COLUMNS)
    thread = tl.arange(0, ROWS * COLUMNS)
    row = tl.program_id(0) // across * ROWS + thread // COLUMNS
    column = tl.program_id(0) % across * COLUMNS + thread % COLUMNS
    inside = (row < height) & (column < width)
    row = tl.minimum(row, height - 1)  # so that nothing is read outside; only pixels inside are written
    column = tl.minimum(column, width - 1)
    first = tl.load(corners + 2 * patch) * row_stride + tl.load(corners + 2 * patch + 1)
    planes += first
    centre = row * row_stride + column
    heads = raw + patch * raw_patch + (row * raw_row + column * raw_column)
    activations = _activated(heads, raw_head, centre, TERMS, BETAS, EVERY, EQ3)
    sums = _sweep(planes, centre, plane_stride, row_stride, activations, MODE != FORWARD, TERMS, BETAS, WINDOW, EVERY)
    w_inverse = 1.0 / sums[0]
    y_c = _load(planes, centre, plane_stride, 3)
    pixel = patch * 3 * height * width + (row * width + column)
    upstream = ()
    if MODE == FORWARD:
        for k in tl.static_range(3):
            tl.store(image + pixel + k * height * width, y_c[k] + sums[1][k] * w_inverse, mask=inside)
    elif MODE == BACKWARD:
        upstream = _load(image + pixel, 0, height * width, 3)
    else:
        wanted = _load(target + first, centre, target_plane, 3)
        relative = tl.load(weight + first + centre)
        loss = tl.zeros_like(w_inverse)
        for k in tl.static_range(3):
            residual = (y_c[k] - wanted[k]) + sums[1][k] * w_inverse
            upstream = upstream + (relative * residual,)
            loss += 0.5 * relative * residual * residual
        total = tl.sum(tl.where(inside, loss, 0.0))
        tl.store(losses + tl.program_id(1) * tl.num_programs(0) + tl.program_id(0), total)
    if MODE != FORWARD:
        to = gradient + patch * gradient_patch + (row * gradient_row + column * gradient_column)
        _scatter(to, gradient_head, heads, raw_head, inside, upstream, activations[0], sums, TERMS, BETAS, EVERY, EQ3)
