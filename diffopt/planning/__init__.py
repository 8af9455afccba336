"""Plans: only the effects that a scene calls for are simulated.

=============  =================================================================
`choosing`     the function `plan`: which effects are in within a tolerance
`plans`        a `Plan`: its effects, reasons, settings, costs
`pilot`        paths of a small picture, and what each needed
`replacing`    what simpler stand-ins change
`reductions`   scenes without some of their effects
`costs`        the cheapest level and its settings
`reasons`      reasons and settings in words
`checking`     the real difference of what is left out
=============  =================================================================
"""

from diffopt.planning.choosing import plan as plan
from diffopt.planning.plans import Plan as Plan
from diffopt.planning.plans import Row as Row
from diffopt.planning.reductions import EFFECTS as EFFECTS
