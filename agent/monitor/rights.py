"""What a user of the fleet page may do besides reading."""

from __future__ import annotations

from agent.commanding.arguments import VERBS

PLAN = "plan"  # put a picture on the plan, and sensors on the picture
RIGHTS = (*VERBS, PLAN)  # the others are commands, which the page forwards
