"""Forces of contacts that are springs. Newton's solvers with such contacts apply these forces, but do not report them."""

import newton
import warp as wp


@wp.func
def point_motion(
    body: int,
    point: wp.vec3,
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_com: wp.array[wp.vec3],
):
    """Return the world position and velocity of a contact point, which is given in the frame of its body, or in the world
    frame if `body` is negative.
    """
    if body < 0:
        return point, wp.vec3(0.0)
    at = wp.transform_point(body_q[body], point)
    arm = at - wp.transform_point(body_q[body], body_com[body])
    return at, wp.spatial_top(body_qd[body]) + wp.cross(wp.spatial_bottom(body_qd[body]), arm)


@wp.kernel
def spring_forces(
    count: wp.array[int],
    shape0: wp.array[int],
    shape1: wp.array[int],
    point0: wp.array[wp.vec3],
    point1: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    margin0: wp.array[float],
    margin1: wp.array[float],
    body_of_shape: wp.array[int],
    friction: wp.array[float],
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_com: wp.array[wp.vec3],
    stiffness: float,
    damping: float,
    slope: float,
    force: wp.array[wp.spatial_vector],
):
    """Compute the force on the first shape of each contact, by the contact law of those solvers whose contacts are springs.
    One thread per contact.

    The spring force is proportional to depth, and the damper acts against approach. Friction opposes sliding in proportion to
    its speed, up to Coulomb's limit with the mean friction coefficient.
    """
    i = wp.tid()
    if i >= count[0]:
        return
    force[i] = wp.spatial_vector()
    first, second = shape0[i], shape1[i]
    up = -normal[i]  # towards the first shape
    at0, velocity0 = point_motion(body_of_shape[first], point0[i], body_q, body_qd, body_com)
    at1, velocity1 = point_motion(body_of_shape[second], point1[i], body_q, body_qd, body_com)
    depth = margin0[i] + margin1[i] - wp.dot(up, at0 - at1)
    if depth <= 0.0:
        return
    velocity = velocity0 - velocity1
    approach = wp.max(-wp.dot(up, velocity), 0.0)
    press = stiffness * depth + damping * approach
    sliding = velocity - up * wp.dot(up, velocity)
    resist = wp.min(slope * wp.length(sliding), 0.5 * (friction[first] + friction[second]) * press)
    force[i] = wp.spatial_vector(press * up - resist * wp.normalize(sliding), wp.vec3(0.0))


def launch_spring_forces(
    model: newton.Model,
    state: newton.State,
    contacts: newton.Contacts,
    springs: tuple[float, float, float],
    force: wp.array,
) -> None:
    """Compute the force on the first shape of each contact from the body poses and velocities in `state`. Write it to
    `force`, world frame [N]. `springs` are stiffness [N/m], damping [N s/m] and friction slope [N s/m].
    """
    wp.launch(
        spring_forces,
        dim=contacts.rigid_contact_max,
        inputs=[
            contacts.rigid_contact_count,
            contacts.rigid_contact_shape0,
            contacts.rigid_contact_shape1,
            contacts.rigid_contact_point0,
            contacts.rigid_contact_point1,
            contacts.rigid_contact_normal,
            contacts.rigid_contact_margin0,
            contacts.rigid_contact_margin1,
            model.shape_body,
            model.shape_material_mu,
            state.body_q,
            state.body_qd,
            model.body_com,
            *springs,
        ],
        outputs=[force],
    )
