"""Runs with events: a mechanism whose motion jumps, or whose constraints change, where a condition crosses zero."""

from udkjax.integrate.events.actions import Action as Action
from udkjax.integrate.events.actions import Attach as Attach
from udkjax.integrate.events.actions import Impact as Impact
from udkjax.integrate.events.actions import Lock as Lock
from udkjax.integrate.events.actions import Log as Log
from udkjax.integrate.events.actions import Release as Release
from udkjax.integrate.events.actions import Stop as Stop
from udkjax.integrate.events.event import Contact as Contact
from udkjax.integrate.events.event import Event as Event
from udkjax.integrate.events.event import Events as Events
from udkjax.integrate.events.event import JointLimit as JointLimit
