"""Runs with events: a mechanism whose motion jumps, or whose constraints change, where a condition crosses zero."""

from udkjax.integrate.events.law.actions import Action as Action
from udkjax.integrate.events.law.actions import Attach as Attach
from udkjax.integrate.events.law.actions import Impact as Impact
from udkjax.integrate.events.law.actions import Lock as Lock
from udkjax.integrate.events.law.actions import Log as Log
from udkjax.integrate.events.law.actions import Release as Release
from udkjax.integrate.events.law.actions import Stop as Stop
from udkjax.integrate.events.law.event import Contact as Contact
from udkjax.integrate.events.law.event import Event as Event
from udkjax.integrate.events.law.event import Events as Events
from udkjax.integrate.events.law.event import JointLimit as JointLimit
