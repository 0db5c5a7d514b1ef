// Elliptic friction cones (MuJoCo documentation, "Computation", and its `mj_constraintUpdate`). A contact has a row along its
// normal, its first, and one for each direction in which it rubs; the first stands for all. With x scaled by the coefficients
// of friction to u, and mu that of the first direction, softened by impratio: N = u_0 and T = |u_1, u_2 ...|. There is no force
// in the dual cone N >= mu T, each row's own where mu N + T <= 0, and between them the cost is a quadratic function of
// N - mu T. Constants: ELLIPTIC (whether there are any), ELLIPTIC_ROW (MuJoCo's number of their type).

const int CONE_ROWS = ELLIPTIC ? ROWS : 1;
LEGGED_SHARED signed char directions[CONE_ROWS];  // of a first row how many its contact has; -1 of others; 0 of other rows
LEGGED_SHARED float rubs[CONE_ROWS];  // what scales x
LEGGED_SHARED float lean[CONE_ROWS];  // between the zones: u / T, scaled again, of the rows but the first
LEGGED_SHARED float bent[CONE_ROWS];  // there: of the first row and the second, the curvature along N - mu T, and across

if (ELLIPTIC) EACH_ROW(r) {
    directions[r] = 0;
    if (r >= nf + arrays.limits.data[world] && number_of(arrays.type, r) == ELLIPTIC_ROW) {
        const int c = number_of(arrays.id, r), n = arrays.contact_dim.data[c];
        const int k = efc_row(r) - arrays.contact_row.data[(long long)c * arrays.contact_row.shape[1]];
        const float* friction = reinterpret_cast<const float*>(arrays.friction.data) + 5 * c;
        const float soften = arrays.impratio_invsqrt.data[world % arrays.impratio_invsqrt.shape[0]];
        directions[r] = k == 0 ? n : -1;
        rubs[r] = k == 0 ? friction[0] * soften : friction[k - 1];
        if (r - k + n > rows) { directions[r] = 0; D[r] = 0.0f; }  // not all of the contact found room
    }
}

if (ELLIPTIC) meet();

// The forces of the contact that begins with row r, for `sides` of the piece of its cost.
[[maybe_unused]] auto press = [&](int r) {
    const int n = directions[r];
    const float mu = rubs[r], N = mu * x[r];
    float squares = 0.0f;
    for (int k = 1; k < n; ++k) { const float u = rubs[r + k] * x[r + k]; squares += u * u; }
    const float T = sqrtf(squares);
    bent[r] = 0.0f;
    if (N >= mu * T) {
        for (int k = 0; k < n; ++k) force[r + k] = curvature[r + k] = 0.0f;
        return 0;
    }
    if (mu * N + T <= 0.0f) {
        for (int k = 0; k < n; ++k) { force[r + k] = -D[r + k] * x[r + k]; curvature[r + k] = D[r + k]; }
        return 1;
    }
    const float along = D[r] / (mu * mu * (1.0f + mu * mu)), normal = along * (mu * T - N) * mu;
    const float across = along * mu * (mu - N / T);
    force[r] = normal;
    curvature[r] = 0.0f;
    bent[r] = along;
    bent[r + 1] = across;
    for (int k = 1; k < n; ++k) {
        lean[r + k] = rubs[r + k] * x[r + k] / T * rubs[r + k];
        force[r + k] = -normal * lean[r + k];
        curvature[r + k] = across * rubs[r + k] * rubs[r + k];
    }
    return 2;
};

// The derivative of its cost along `jv`, at x + alpha * jv, and the second one.
[[maybe_unused]] auto press_along = [&](int r, float alpha, float& first, float& second) {
    const int n = directions[r];
    const float mu = rubs[r], N = mu * (x[r] + alpha * jv[r]), Nv = mu * jv[r];
    float uu = 0.0f, uv = 0.0f, vv = 0.0f;
    for (int k = 1; k < n; ++k) {
        const float u = rubs[r + k] * (x[r + k] + alpha * jv[r + k]), v = rubs[r + k] * jv[r + k];
        uu += u * u; uv += u * v; vv += v * v;
    }
    const float T = sqrtf(uu);
    if (N >= mu * T) return;
    if (mu * N + T <= 0.0f) {
        for (int k = 0; k < n; ++k) {
            first += D[r + k] * (x[r + k] + alpha * jv[r + k]) * jv[r + k];
            second += D[r + k] * jv[r + k] * jv[r + k];
        }
        return;
    }
    const float along = D[r] / (mu * mu * (1.0f + mu * mu));
    const float Tv = uv / T, change = Nv - mu * Tv;
    first += along * (N - mu * T) * change;
    second += along * (change * change + (mu * T - N) * mu * most(vv - Tv * Tv, 0.0f) / T);
};

// Of the Hessian's entry (i, j) what of a cone between the zones is not in the rows' own curvature: along N - mu T, and that
// across does not reach the direction in which it rubs.
[[maybe_unused]] auto bend_of = [&](int r, int i, int j) {
    float one = 0.0f, other = 0.0f, lean_i = 0.0f, lean_j = 0.0f;
    with_row(r, [&](int, const float* row) { one = row[i]; other = row[j]; });
    for (int k = 1; k < directions[r]; ++k)
        with_row(r + k, [&](int, const float* row) { lean_i += lean[r + k] * row[i]; lean_j += lean[r + k] * row[j]; });
    return bent[r] * rubs[r] * rubs[r] * (one - lean_i) * (other - lean_j) - bent[r + 1] * lean_i * lean_j;
};
