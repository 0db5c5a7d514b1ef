// Elliptic friction cones (MuJoCo documentation, "Computation", and its `mj_constraintUpdate`). A contact's first row lies
// along its normal, and represents the contact; each other row lies along a direction of friction. Let mu be the friction
// coefficient of the first direction, softened by impratio. Let u be x times mu in the first row, and x times the row's
// friction coefficient in the other rows. Let N = u_0 and T = |u_1, u_2 ...|. Zone 0, the dual cone N >= mu T, has no force.
// In zone 1, mu N + T <= 0, the force of each row depends on this row alone. In zone 2, between them, the cost is a quadratic
// function of N - mu T. Constants: ELLIPTIC (the model has elliptic cones), ELLIPTIC_ROW (MuJoCo's number of their rows'
// type).

const int CONE_ROWS = ELLIPTIC ? ROWS : 1;
// number of directions in the first row of a contact; -1 in its other rows; 0 in rows without a cone
LEGGED_SHARED signed char directions[CONE_ROWS];
LEGGED_SHARED float rubs[CONE_ROWS];  // factors that scale x to u
LEGGED_SHARED float lean[CONE_ROWS];  // in zone 2, in rows of friction: u / T times `rubs`
// in zone 2: curvature along N - mu T in the first row, and across it in the second
LEGGED_SHARED float bent[CONE_ROWS];

if (ELLIPTIC) EACH_ROW(r) {
    directions[r] = 0;
    if (r >= nf + arrays.limits.data[world] && number_of(arrays.type, r) == ELLIPTIC_ROW) {
        const int c = number_of(arrays.id, r), n = arrays.contact_dim.data[c];
        const int k = efc_row(r) - arrays.contact_row.data[(long long)c * arrays.contact_row.shape[1]];
        const float* friction = reinterpret_cast<const float*>(arrays.friction.data) + 5 * c;
        const float soften = arrays.impratio_invsqrt.data[world % arrays.impratio_invsqrt.shape[0]];
        directions[r] = k == 0 ? n : -1;
        rubs[r] = k == 0 ? friction[0] * soften : friction[k - 1];
        if (r - k + n > rows) { directions[r] = 0; D[r] = 0.0f; }  // not all rows of the contact fitted
    }
}

if (ELLIPTIC) meet();

// Computes the forces of the contact that begins with row r. Returns the contact's zone, which is its state.
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

// Adds the first and second derivatives of the contact's cost along `jv`, at x + alpha * jv.
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

// Returns what a cone in zone 2 adds to entry (i, j) of the Hessian, besides the curvature of the cone's rows: the curvature
// along N - mu T, minus the curvature across it in the direction of sliding, in which the cost has no curvature.
[[maybe_unused]] auto bend_of = [&](int r, int i, int j) {
    float one = 0.0f, other = 0.0f, lean_i = 0.0f, lean_j = 0.0f;
    with_row(r, [&](int, const float* row) { one = row[i]; other = row[j]; });
    for (int k = 1; k < directions[r]; ++k)
        with_row(r + k, [&](int, const float* row) { lean_i += lean[r + k] * row[i]; lean_j += lean[r + k] * row[j]; });
    return bent[r] * rubs[r] * rubs[r] * (one - lean_i) * (other - lean_j) - bent[r + 1] * lean_i * lean_j;
};
