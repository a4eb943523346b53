"""A lifecycle node that survives a request for an impossible transition."""

from __future__ import annotations

from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNode as RclpyLifecycleNode

__all__ = ["LifecycleNode"]


class LifecycleNode(RclpyLifecycleNode):
    """rclpy's lifecycle node, which refuses impossible transitions.

    rclpy's C error leaves the service's callback, so that a second ``activate`` would end a controller that holds a
    pendulum. The callback is private there; this overrides it under its mangled name.
    """

    def _LifecycleNodeMixin__on_change_state(  # noqa: N802
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        possible = {transition[0]: transition[1] for transition in self._state_machine.available_transitions}
        wanted = request.transition
        fits = wanted.label in possible.values() if wanted.label else wanted.id in possible
        if not fits:
            _, state = self._state_machine.current_state
            self.get_logger().error(
                f"transition {wanted.label or wanted.id} is not possible in state {state}; "
                f"expected one of {', '.join(sorted(possible.values()))}"
            )
            response.success = False
            return response
        return super()._LifecycleNodeMixin__on_change_state(request, response)
