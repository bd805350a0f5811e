"""The own recording format, a folder for each robot: writer and reader. docs/recording.md says every byte."""
