"""The description of one sensor.

In: a YAML file.
Out: `SensorDescription` with its pattern and the parameters of every stage.
"""
