"""A node with a context of its own, whose callbacks run in a thread of its own."""

from __future__ import annotations

import atexit
import threading
from contextlib import suppress
from typing import Any

from stereo_ore.plant.ros2.install import MessageTypes, require

JOIN_S = 5.0


class Node:
    """An open node; `close` it. What is left open at the end of the program is closed then: its
    thread would end it with an abort.

    Parameters
    ----------
    name, namespace : str
        Its name, and what its topics' names begin with.
    spins : bool
        Whether it has callbacks.
    """

    def __init__(self, name: str, *, spins: bool, namespace: str = "") -> None:
        require()
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        # A context of its own: this program's options are none of ROS's, and signals are ours.
        self._context = Context()
        rclpy.init(context=self._context, args=[], signal_handler_options=SignalHandlerOptions.NO)
        self.ros: Any = rclpy.create_node(
            name,
            context=self._context,
            namespace=namespace,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self.types = MessageTypes()
        atexit.register(self.close)
        self._thread: threading.Thread | None = None
        if spins:
            self._executor = SingleThreadedExecutor(context=self._context)
            self._executor.add_node(self.ros)
            self._thread = threading.Thread(target=self._spin, daemon=True, name=name)
            self._thread.start()

    def topics(self) -> dict[str, str]:
        """Topics that are known now, and their first type."""
        return {topic: kinds[0] for topic, kinds in self.ros.get_topic_names_and_types()}

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException

        with suppress(ExternalShutdownException):
            self._executor.spin()

    def close(self) -> None:
        """End callbacks, and leave the network; a second time nothing happens."""
        atexit.unregister(self.close)
        if not self._context.ok():
            return
        if self._thread is not None:
            self._executor.shutdown(timeout_sec=JOIN_S)
            self._thread.join(JOIN_S)
        self.ros.destroy_node()
        self._context.try_shutdown()
