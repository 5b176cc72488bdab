"""Ready-made components: scan plans, surveys, tip judge and repair, notes, notifications, the recorder.

Each is an ordinary component: it derives from `afspm.Component`, is named by an entry point, and could be yours.
"""
