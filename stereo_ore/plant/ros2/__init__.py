"""ROS 2, live: frames from a camera driver's topics, results as topics; needs the extra
``ros2`` or a sourced ROS 2.
"""
