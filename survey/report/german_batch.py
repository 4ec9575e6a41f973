"""The overview of a batch in German."""

GERMAN_BATCH = {
    "Overview of {n} surveys": "Übersicht über {n} Vermessungen",
    "Overview of a batch": "Übersicht eines Stapels",
    "Failures": "Fehlgeschlagen",
    "Global tests": "Globaltests",
    "Control charts": "Regelkarten",
    "All numbers": "Alle Größen",
    "Folders": "Ordner",
    "{n} failed": "{n} fehlgeschlagen",
    "In control": "Alles im Rahmen",
    "{failed} of {n} surveys could not be adjusted, {tested} fail their global test; {k} of {m} numbers are not in "
    "control over the epochs.": (
        "{failed} von {n} Vermessungen ließen sich nicht ausgleichen, {tested} bestehen ihren Globaltest nicht; "
        "{k} von {m} Größen sind über die Epochen nicht stabil."
    ),
    "surveys": "Vermessungen",
    "not adjusted": "nicht ausgeglichen",
    "global test failed": "Globaltest nicht bestanden",
    "unchanged, not adjusted again": "unverändert, nicht neu ausgeglichen",
    "{n} s": "{n} s",
    "time of all adjustments": "Zeit aller Ausgleichungen",
    "What could not be adjusted, where the error is and what to do. Everything else was adjusted as usual.": (
        "Was sich nicht ausgleichen ließ, wo der Fehler liegt und was zu tun ist. Alles andere wurde trotzdem "
        "ausgeglichen."
    ),
    "Survey": "Vermessung",
    "Why": "Warum",
    "Message": "Meldung",
    "Tries": "Versuche",
    "expected": "erwartet",
    "Worst group": "Schlechteste Gruppe",
    "Solved, but the residuals are larger than the sigmas say. Worst group: the one whose weighted square sum is "
    "furthest above its expectation, with the factor that its sigmas would need.": (
        "Gelöst, aber die Verbesserungen sind größer, als die Standardabweichungen erwarten lassen. Schlechteste "
        "Gruppe: die, deren gewichtete Quadratsumme am weitesten über ihrer Erwartung liegt, mit dem Faktor, den ihre "
        "Standardabweichungen bräuchten."
    ),
    "Deviations from the weighted mean of the epochs in control (hollow: set aside). Band: three sigmas as each "
    "epoch claims them; dashed: three sigmas from the scatter (median moving range). Red: outside of its own "
    "sigmas, orange: outside of the scatter alone; orange line: {side} in a row on one side, or {trend} steadily "
    "up or down. A cross is an epoch without result. Chance alone puts {expected} of all {n} points outside.": (
        "Abweichungen vom gewichteten Mittel der stabilen Epochen (hohl: beiseitegelassen). Band: drei "
        "Standardabweichungen, wie jede Epoche sie angibt; gestrichelt: drei aus der Streuung (Median der gleitenden "
        "Spannweite). Rot: außerhalb der eigenen, orange: nur außerhalb der Streuung; orange Linie: {side} in Folge "
        "auf einer Seite oder {trend} stetig auf- oder abwärts. Ein Kreuz ist eine Epoche ohne Ergebnis. Der Zufall "
        "allein bringt {expected} von allen {n} Punkten nach außen."
    ),
    "{n} more charts": "{n} weitere Karten",
    "Control chart of {name}": "Regelkarte von {name}",
    "mean {mean} {unit}": "Mittel {mean} {unit}",
    "Number": "Größe",
    "Mean": "Mittel",
    "σ of one": "σ einer",
    "Scatter": "Streuung",
    "Ratio": "Verhältnis",
    "Per epoch": "je Epoche",
    "Finding": "Befund",
    "σ of one: median of what the epochs claim. Scatter: sigma from the moving range. Ratio: deviations over their "
    "sigmas, 1 where sigmas can be believed; p: that chance makes it so large. Per epoch: slope, and p of none. "
    "Marked where a test fails at {level} % for all numbers together, or a run is too long for chance.": (
        "σ einer: Median der Angaben der Epochen. Streuung: σ aus der gleitenden Spannweite. Verhältnis: Abweichungen "
        "durch ihre Standardabweichungen, 1, wo man ihnen glauben kann; p: dass der Zufall es so groß macht. Je "
        "Epoche: Steigung, und p für keine. Markiert, wo ein Test auf dem Niveau {level} % für alle Größen zusammen "
        "scheitert oder eine Folge für Zufall zu lang ist."
    ),
    "epochs disagree": "Epochen widersprechen sich",
    "drift": "Drift",
    "outside:": "außerhalb:",
    "on one side": "auf einer Seite",
    "rising": "steigend",
    "falling": "fallend",
    "adjusted": "ausgeglichen",
    "unchanged": "unverändert",
    "as before": "wie zuvor",
    "Not used": "Nicht verwendet",
    "Title": "Titel",
    "Reason": "Grund",
    "n observations, u unknowns. A name leads to the survey's own report.": (
        "n Beobachtungen, u Unbekannte. Ein Name führt zum eigenen Bericht der Vermessung."
    ),
    "no project": "kein Projekt",
    "error in the project's files": "Fehler in den Dateien des Projekts",
    "not determined": "nicht bestimmt",
    "did not converge": "nicht konvergiert",
    "cannot be adjusted": "nicht ausgleichbar",
    "file or folder not accessible": "Datei oder Ordner nicht erreichbar",
    "out of memory": "Speicher reicht nicht",
    "another command works on it": "ein anderer Befehl arbeitet daran",
    "its process ended abruptly": "Prozess brach ab",
    "lost on the cluster": "im Cluster verloren",
    "internal error": "interner Fehler",
}
