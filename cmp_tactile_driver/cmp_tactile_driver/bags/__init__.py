"""ROS 2 bags, without ROS.

In: bags, folders of images, messages to be kept.
Out: recorded messages in their own timing; written bags.
"""
