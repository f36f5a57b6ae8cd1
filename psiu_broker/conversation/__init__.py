"""Calls to robots: turns, tries and deadlines, and which reply is whose."""

from psiu_broker.conversation.complaints import Traffic
from psiu_broker.conversation.conversations import Conversations, Links
from psiu_broker.conversation.under_way import Robot

__all__ = ["Conversations", "Links", "Robot", "Traffic"]
