"""Talkers who change their way of moving: a Markov chain over motion models."""

from probtrack.switching.chain import MarkovChain as MarkovChain
from probtrack.switching.dynamics import SwitchingDynamics as SwitchingDynamics
from probtrack.switching.presets import PRESETS as PRESETS
from probtrack.switching.presets import moving_and_stopped as moving_and_stopped
from probtrack.switching.presets import odas as odas
from probtrack.switching.presets import speech_and_silence as speech_and_silence
from probtrack.switching.presets import teleconference as teleconference
