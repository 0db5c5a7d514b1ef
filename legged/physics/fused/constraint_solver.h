// MuJoCo's Newton solver for the constraint forces of one world. This file comes after constraint_rows.h, elliptic_cones.h
// and elimination.h. Constants: DAMPED (dampers are integrated implicitly), and SPLIT, FRICTION, ELLIPTIC, KNOWN as there.

const float tolerance = arrays.tolerance, ls_tolerance = arrays.ls_tolerance;
int round = 0;
const float INFINITE = 3.0e38f, ENOUGH = 0.1f;
float alpha = 0.0f;  // last step length; if it is 1 and no state changes, the minimum is reached
[[maybe_unused]] float dragged[DOFS];  // dry friction, as a force against the motion
while (true) {
    // The first step goes to the minimum of the quadratic function that the states of the last step define.
    const bool guessing = KNOWN && round == 0 && had > 0;
    if (!advancing) {
        // Compute the forces, whether rows changed their states, and the gradient.
        bool changed = false;
        EACH_ROW(r) {
            if (ELLIPTIC && directions[r] < 0) continue;
            int state;
            if (ELLIPTIC && directions[r] > 0) {
                state = press(r);
                changed |= state == 2;  // zone 2: the cost is not quadratic
            } else {
                float piece = states[r];
                const bool given = guessing && states[r] != UNKNOWN;
                const float loss = FRICTION && !DRY && r < nf ? number_of(arrays.frictionloss, r) : 0.0f;
                force[r] = given ? -rub_on(D[r], loss, x[r], piece) : -pull(r, x[r], piece);
                curvature[r] = most(piece, 0.0f);
                state = piece > 0.0f ? 1 : (int)piece;
            }
            changed |= state != states[r];
            states[r] = state;
        }
        if (DRY) EACH_DOF(i) {
            float piece = dry_states[i];
            const bool given = guessing && dry_states[i] != UNKNOWN;
            const float at = OF(a, i) - dry_reference[i];
            OF(dragged, i) = given ? rub_on(dry_D[i], dry_loss[i], at, piece) : rub(dry_D[i], dry_loss[i], at, piece);
            dry_curvature[i] = most(piece, 0.0f);
            const int state = piece > 0.0f ? 1 : (int)piece;
            changed |= state != dry_states[i];
            dry_states[i] = state;
        }
        if (ELLIPTIC) meet();
        bool coupled = false;
        pushers = near_pushers = 0;
        EVERY_ROW(r) {
            const bool pushes = r < rows && (force[r] != 0.0f || curvature[r] != 0.0f);
            const int place = rank(pushes, pushers);
            rank(pushes && r < KEPT, near_pushers);
            if (!pushes) continue;
            pushing[place] = r;
            if (SPLIT) coupled |= couples[r];
        }
        changed = any(changed);
        several = SPLIT && any(coupled);
        meet();
        float squares = 0.0f;
        float pushed_of[DOFS] = {};
        each_pushing([&](int r, const float* row) { EACH_DOF(i) OF(pushed_of, i) += row[i] * force[r]; });
        EACH_DOF(i) {
            OF(grad, i) = OF(rest, i) - (DRY ? OF(pushed_of, i) - OF(dragged, i) : OF(pushed_of, i));
            squares += OF(grad, i) * OF(grad, i);
        }
        squares = sum(squares);
        if (round == arrays.most_rounds || (!guessing && scale * sqrtf(squares) < tolerance) || (alpha == 1.0f && !changed)) {
            if (!DAMPED) break;
            advancing = true;
        }
    }
    // Compute the step s = -H^-1 grad, or the acceleration with implicit dampers.
    EACH_DOF(i) shown[i] = OF(s, i) = DAMPED && advancing ? OF(rest, i) + smooth(i) - OF(grad, i) : -OF(grad, i);
    meet();
    if (SPLIT && (advancing || !several)) solve(Branches{}); else solve(Path{});
    if (DAMPED && advancing) {
        EACH_DOF(i) arrays.advance.data[(long long)world * NV + i] = OF(s, i);
        break;
    }

    // Compute J s for every row. The inertial cost has the derivative slope + alpha * bend along the step.
    float sums[4] = {};
    EACH_DOF(i) {
        float total = 0.0f;
        UNROLLED for (int j = 0; j < NV; ++j) total += M[i * STRIDE + j] * shown[j];
        OF(Ms, i) = total;
        sums[0] += OF(s, i) * OF(rest, i);
        sums[1] += OF(s, i) * total;
        sums[2] += OF(s, i) * OF(s, i);
        sums[3] -= OF(s, i) * OF(grad, i);
    }
    sum_four(sums);
    const float slope = sums[0], bend = sums[1], length = sums[2], decrement = sums[3];
    // Stop if the step gains too little, or if a number is NaN.
    if (!(scale * 0.5f * decrement >= (guessing ? -INFINITE : tolerance))) {
        if (!DAMPED) break;
        advancing = true;
        continue;
    }
    EACH_ROW(r) jv[r] = along_row(r);
    if (ELLIPTIC) meet();
    // The line search need not reach the minimum: the next iteration reduces the rest of the slope.
    const float flat = most(tolerance * ls_tolerance * sqrtf(length) / scale, ENOUGH * decrement);
    alpha = 1.0f;
    float low = 0.0f, high = -1.0f;
    // The second step needs no line search either, since the row states that it starts from are mostly right.
    const bool whole = guessing || (KNOWN && round == 1);
    ROLLED for (int k = whole ? arrays.most_searches : 0; k < arrays.most_searches; ++k) {
        float first = 0.0f, second = 0.0f;
        EACH_ROW(r) {
            if (ELLIPTIC && directions[r] != 0) {
                if (directions[r] > 0) press_along(r, alpha, first, second);
                continue;
            }
            float piece;
            first += jv[r] * pull(r, x[r] + alpha * jv[r], piece);
            second += jv[r] * jv[r] * most(piece, 0.0f);
        }
        if (DRY) EACH_DOF(i) {
            float piece;
            first += OF(s, i) * rub(dry_D[i], dry_loss[i], OF(a, i) + alpha * OF(s, i) - dry_reference[i], piece);
            second += OF(s, i) * OF(s, i) * most(piece, 0.0f);
        }
        first = sum(first) + slope + alpha * bend;
        second = sum(second) + bend;
        if (!(fabsf(first) > flat)) break;
        if (first < 0.0f) low = alpha; else high = alpha;
        float next = alpha - first / second;
        if (fabsf(next - alpha) <= 1e-7f * alpha) break;  // float32 resolves no smaller change
        if (high > 0.0f && (next <= low || next >= high)) next = 0.5f * (low + high);
        alpha = next;
    }
    EACH_DOF(i) {
        OF(a, i) += alpha * OF(s, i);
        OF(rest, i) += alpha * OF(Ms, i);
    }
    if (ELLIPTIC) meet();
    EACH_ROW(r) x[r] += alpha * jv[r];
    if (ELLIPTIC) meet();
    ++round;
}

EACH_DOF(i) {
    arrays.qacc.data[world * arrays.qacc.shape[1] + i] = OF(a, i);
    arrays.inertial.data[world * arrays.inertial.shape[1] + i] = OF(rest, i) + smooth(i);
    arrays.qfrc_constraint.data[world * arrays.qfrc_constraint.shape[1] + i] = OF(rest, i) - OF(grad, i);
}
EACH_ROW(r) arrays.efc_force.data[(long long)world * arrays.efc_force.shape[1] + efc_row(r)] = force[r];
if (DRY) EACH_DOF(i) {
    if (dry_row[i] >= 0) arrays.efc_force.data[(long long)world * arrays.efc_force.shape[1] + dry_row[i]] = -OF(dragged, i);
}
if (lane == 0) arrays.rounds.data[world] = round;
if (KNOWN) {
    EACH_ROW(r) if (r >= ne) last_rows(1 + efc_row(r) - ne) = key_of(efc_row(r)) << 2 | (states[r] + 2);
    if (DRY) EACH_DOF(i) if (dry_row[i] >= 0) last_rows(1 + dry_row[i] - ne) = i << 2 | (dry_states[i] + 2);
    if (lane == 0) last_rows(0) = of_all - ne;
}
