"""The report in German: texts by their English form, and patterns of messages that the adjustment makes."""

from survey.report.german_batch import GERMAN_BATCH

GERMAN = {
    # instruments and surfaces
    "Instruments and surfaces": "Instrumente und Flächen",
    "Vertical": "Lotrichtung",
    "upwards in the world": "aufwärts in der Welt",
    "Instrument": "Instrument",
    "Setup": "Aufstellung",
    "Laser beam": "Laserstrahl",
    "along": "entlang",
    "direction": "Richtung",
    "plane": "Ebene",
    "line": "Gerade",
    "sphere": "Kugel",
    # page and summary
    "Adjustment report": "Ausgleichungsbericht",
    "Summary": "Übersicht",
    "Groups": "Gruppen",
    "Picture": "Bild",
    "Cameras": "Kameras",
    "Poses": "Lagen",
    "Turntables": "Drehtische",
    "Targets": "Zieltafeln",
    "Points": "Punkte",
    "Network": "Netz",
    "Loops": "Schleifen",
    "Pairs": "Paare",
    "Observations": "Beobachtungen",
    "Image points": "Bildpunkte",
    "Excluded by people": "Von Personen ausgeschlossen",
    "What": "Was",
    "Reason": "Grund",
    "Who": "Wer",
    "When": "Wann",
    "Readings": "Ablesungen",
    "Largest |w| now": "Größtes |w| jetzt",
    "no reason given": "ohne Angabe eines Grundes",
    "names nothing": "bezeichnet nichts",
    "fits now": "passt jetzt",
    "does not fit": "passt nicht",
    "Nothing is excluded by people.": "Von Personen ist nichts ausgeschlossen.",
    "{people} observations are left out by people (observations/exclusions.csv), {files} only by used = false in "
    "their table, {run} by this adjustment. What is left out is predicted and tested as long as the others "
    "determine it: a small residual says that it would fit now.": "{people} Beobachtungen sind von Personen "
    "ausgeschlossen (observations/exclusions.csv), {files} nur durch used = false in ihrer Tabelle, {run} durch diese "
    "Ausgleichung. Ausgeschlossenes wird vorhergesagt und getestet, solange die übrigen es bestimmen: Eine kleine "
    "Verbesserung sagt, dass es jetzt passen würde.",
    "{n} observations were left out by this adjustment.": "{n} Beobachtungen hat diese Ausgleichung weggelassen.",
    '<a href="#excluded">{n} observations</a> are left out by people or their tables.':
    '<a href="#excluded">{n} Beobachtungen</a> sind von Personen oder in ihren Tabellen ausgeschlossen.',
    "Command": "Befehl",
    "{n} images, each with the hash of the file that its points come from":
    "{n} Bilder, jedes mit der Prüfsumme der Datei, aus der seine Punkte stammen",
    "Inputs": "Eingangsdaten",
    "Options": "Einstellungen",
    "Versions": "Programmstände",
    "Passed": "Bestanden",
    "Needs a look": "Bitte prüfen",
    "Failed": "Nicht bestanden",
    "passed": "bestanden",
    "failed": "nicht bestanden",
    "{n} more warnings in solution.json.": "{n} weitere Warnungen in solution.json.",
    '<a href="#image-points">{n} image points</a> are suspect.': (
        '<a href="#image-points">{n} Bildpunkte</a> sind verdächtig.'
    ),
    '<a href="#observations">{n} other observations</a> are suspect.': (
        '<a href="#observations">{n} andere Beobachtungen</a> sind verdächtig.'
    ),
    "Image": "Bild",
    "Images": "Bilder",
    "No warnings, nothing suspect, nothing left out.": "Keine Warnungen, nichts verdächtig, nichts ausgelassen.",
    "sigma0 (a priori 1)": "sigma0 (a priori 1)",
    "observations": "Beobachtungen",
    "unknowns": "Unbekannte",
    "redundancy": "Redundanz",
    "iterations": "Iterationen",
    " (not converged)": " (nicht konvergiert)",
    "last step": "letzter Schritt",
    "datum": "Datum",
    "given": "gegeben",
    "inner": "innere Bedingungen",
    "{kind}, defect {n}": "{kind}, Defekt {n}",
    "Sigmas of unknowns here are <b>a posteriori</b>: multiplied by sigma0 = {factor}.": (
        "Die Standardabweichungen der Unbekannten sind <b>a posteriori</b>: multipliziert mit sigma0 = {factor}."
    ),
    "Sigmas of unknowns here are <b>a priori</b>: they follow from the sigmas of the observations alone.": (
        "Die Standardabweichungen der Unbekannten sind <b>a priori</b>: sie folgen allein aus denen der Beobachtungen."
    ),
    "Sigmas of observations, standardized residuals and tests are a priori. Residuals are adjusted minus observed.": (
        "Standardabweichungen der Beobachtungen, standardisierte Verbesserungen und Tests sind a priori. "
        "Verbesserungen sind ausgeglichen minus beobachtet."
    ),
    "Global test": "Globaltest",
    "cautious sigmas": "vorsichtige Sigmas",
    "Not computed": "Nicht berechnet",
    "Parts of the survey": "Teile der Vermessung",
    "Part": "Teil",
    "Parts": "Teile",
    "Table": "Drehtisch",
    "Set-up": "Aufstellung",
    "Factor": "Faktor",
    "fits": "passt",
    "Every group, camera, epoch, target, table, set-up and instrument tested for itself, and {n} changes and shapes of "
    "cameras, targets and tables: {all} tests at {level} % together. The {most} with the smallest p are listed.": (
        "Jede Gruppe, Kamera, Epoche, Zieltafel, jeder Tisch, Aufbau und jedes Instrument für sich geprüft, dazu {n} "
        "Änderungen und Formen von Kameras, Zieltafeln und Tischen: {all} Prüfungen, zusammen mit {level} %. Gezeigt "
        "sind die {most} mit dem kleinsten p."
    ),
    "No global test: there is no redundancy.": "Kein Globaltest: es gibt keine Redundanz.",
    "Global test {word} omega = {omega}, redundancy {r}, accepted between {lower} and {upper} at {level} %": (
        "Globaltest {word} Omega = {omega}, Redundanz {r}, angenommen zwischen {lower} und {upper} bei {level} %"
    ),
    "{low} to {high}": "{low} bis {high}",
    # groups
    "Groups of observations": "Beobachtungsgruppen",
    "Group": "Gruppe",
    "Omega": "Omega",
    "Variance factor": "Varianzfaktor",
    "Scale of sigmas": "Faktor der Sigmas",
    "Deviation [σ]": "Abweichung [σ]",
    "The variance factor is the weighted square sum omega over the redundancy of the group; its root is the number "
    "by which the sigmas given for the group would have to be multiplied to agree with its residuals. Deviation: "
    "of omega from the redundancy, in sigmas of chi-square.": (
        "Der Varianzfaktor ist die gewichtete Quadratsumme Omega durch die Redundanz der Gruppe; mit seiner Wurzel "
        "wären die angegebenen Sigmas der Gruppe zu multiplizieren, damit sie zu den Verbesserungen passen. "
        "Abweichung: von Omega gegen die Redundanz, in Sigmas der Chi-Quadrat-Verteilung."
    ),
    # pictures
    "The survey": "Die Vermessung",
    "95 % confidence ellipsoids of points (red) and stations (green), enlarged {n} times. "
    "Cameras are drawn at the first epoch; thin lines are their axes at others, dash-dotted lines those of tables.": (
        "95-%-Konfidenzellipsoide der Punkte (rot) und Standpunkte (grün), {n}-fach vergrößert. Kameras sind in der "
        "ersten Epoche gezeichnet; dünne Linien sind ihre Achsen in anderen, strichpunktierte die der Drehtische."
    ),
    "{n} points are left out for clarity.": "{n} Punkte sind der Übersicht halber weggelassen.",
    "Plan (world x to the right, y up)": "Grundriss (Welt-x nach rechts, y nach oben)",
    "Perspective (world z up)": "Perspektive (Welt-z nach oben)",
    # unknowns
    "held": "fest",
    "free": "frei",
    "prior": "Vorwissen",
    "tied": "gekoppelt",
    "fixed": "fest",
    "epoch": "je Epoche",
    "table": "Drehtisch",
    "Camera": "Kamera",
    "Parameter": "Parameter",
    "Value": "Wert",
    "σ": "σ",
    "Unit": "Einheit",
    "Status": "Status",
    "|value| / σ": "|Wert| / σ",
    "Held at zero: {names}.": "Auf null gehalten: {names}.",
    "Residual vectors point from the observed to the adjusted position. Red: suspect, orange: not used. "
    "A pattern in the mean per cell is what the lens model leaves over; empty cells hold no points.": (
        "Die Vektoren zeigen von der beobachteten zur ausgeglichenen Lage. Rot: verdächtig, orange: nicht verwendet. "
        "Ein Muster in den Zellmitteln ist, was das Objektivmodell übrig lässt; leere Zellen haben keine Punkte."
    ),
    "{width} × {height} px on station {station} · {images} images, {points} points": (
        "{width} × {height} px auf Standpunkt {station} · {images} Bilder, {points} Punkte"
    ),
    "lens model {model}": "Objektivmodell {model}",
    "RMS residual {rms} px": "RMS der Verbesserungen {rms} px",
    "with": "mit",
    "correlated above 95 %": "über 95 % korreliert",
    "No correlation above 95 % within the lens.": "Keine Korrelation über 95 % innerhalb des Objektivs.",
    "not significant": "nicht signifikant",
    "{names}: not distinguishable from zero at 95 %.": "{names}: bei 95 % nicht von null zu unterscheiden.",
    "Poses of stations, tables and targets": "Lagen von Standpunkten, Drehtischen und Zieltafeln",
    "Pose": "Lage",
    "Epoch": "Epoche",
    "A pose a_from_b is the origin of b in a and R = Rz Ry Rx. Below each coordinate its sigma along the axes of a in "
    "mm, below each angle the sigma of a small rotation about the same axis of b in arcseconds.": (
        "Eine Lage a_from_b ist der Ursprung von b in a und R = Rz Ry Rx. Unter jeder Koordinate ihre "
        "Standardabweichung längs der Achsen von a in mm, unter jedem Winkel die einer kleinen Drehung um dieselbe "
        "Achse von b in Bogensekunden."
    ),
    "{n} poses by epoch": "{n} Lagen je Epoche",
    "{n} more in solution.json.": "{n} weitere in solution.json.",
    "axes {axes}": "Achsen {axes}",
    " then ": ", dann ",
    "{n} epochs: adjusted angles": "{n} Epochen: ausgeglichene Winkel",
    "station {name}": "Standpunkt {name}",
    "the world": "der Welt",
    "Target": "Zieltafel",
    "Stands on": "Steht auf",
    "Motion": "Bewegung",
    "Poses per epoch": "Lagen je Epoche",
    "Warp of {name}": "Verbiegung von {name}",
    "Point": "Punkt",
    "World coordinates with sigmas below; a, b, c: semi-axes of the 95 % confidence ellipsoid ({k} sigmas). "
    "Least precise first.": (
        "Weltkoordinaten, darunter ihre Standardabweichungen; a, b, c: Halbachsen des 95-%-Konfidenzellipsoids ({k} "
        "Sigmas). Die ungenauesten zuerst."
    ),
    # pictures of a camera
    "Residuals": "Verbesserungen",
    "Residual vectors of camera {name}": "Verbesserungsvektoren der Kamera {name}",
    "{shown} of {n} shown": "{shown} von {n} gezeigt",
    "all {n}": "alle {n}",
    "Mean per cell, over the coverage": "Mittel je Zelle, über der Belegung",
    "{k} of {n} cells hold points": "{k} von {n} Zellen mit Punkten",
    "Mean residuals and coverage of camera {name}": "Mittlere Verbesserungen und Belegung der Kamera {name}",
    "Standardized residuals, u and v": "Standardisierte Verbesserungen, u und v",
    "{n} beyond ±5": "{n} jenseits ±5",
    "normal": "normal",
    "Histogram of standardized residuals of camera {name}": (
        "Histogramm der standardisierten Verbesserungen der Kamera {name}"
    ),
    # pairs and loops
    "Network of measured pairs": "Netz der gemessenen Paare",
    "poses": "Lagen",
    "rotations": "Drehungen",
    "stations": "Standpunkte",
    "parts": "Teile",
    "independent unknown {each}": "unabhängige unbekannte {each}",
    "pairs measured": "gemessene Paare",
    "{n} of {most} measurable": "{n} von {most} messbaren",
    "triangle conditions": "Dreiecksbedingungen",
    "independent conditions": "unabhängige Bedingungen",
    "{n} equations": "{n} Gleichungen",
    "conditions per pair": "Bedingungen je Paar",
    "of these through given stations": "davon über gegebene Standpunkte",
    "n stations have n − 1 independent relative poses; every independent loop of pairs adds a condition. A pair "
    "that closes no loop cannot be checked. Pairs that share all their loops: an error in one is seen, but not "
    "told from one in the others.": (
        "n Standpunkte haben n − 1 unabhängige relative Lagen; jede unabhängige Schleife aus Paaren gibt eine "
        "Bedingung. Ein Paar, das keine Schleife schließt, ist unkontrolliert. Bei Paaren mit denselben Schleifen "
        "wird ein Fehler bemerkt, aber nicht dem einen oder anderen zugeordnet."
    ),
    "Part {i}: {names}": "Teil {i}: {names}",
    "Close no loop: {names}": "Schließen keine Schleife: {names}",
    "Errors seen but not told apart: {names}": "Fehler bemerkbar, aber nicht zu trennen: {names}",
    "{n} more such groups in solution.json": "{n} weitere solche Gruppen in solution.json",
    " and {n} more": " und {n} weitere",
    "Published methods": "Veröffentlichte Verfahren",
    "The published step-by-step methods on the same observations. Claimed: the sigma as its step states it, with "
    "all steps before taken as free of error. Published: the sigma that the observations cause, through all "
    "steps. Difference: published minus joint, rotations as small turns about the axes on the right.": (
        "Die veröffentlichten schrittweisen Verfahren mit denselben Beobachtungen. Behauptet: das σ, wie es der "
        "Schritt selbst angibt, alle Schritte davor als fehlerfrei genommen. Veröffentlicht: das σ, das die "
        "Beobachtungen durch alle Schritte verursachen. Differenz: veröffentlicht minus gemeinsam, Drehungen als "
        "kleine Drehungen um die Achsen des rechten Systems."
    ),
    "Calibration of the head, step by step": "Kalibrierung des Kopfes, Schritt für Schritt",
    "Iteration of measured pairs over their loops": "Iteration gemessener Paare über ihre Schleifen",
    "not run": "nicht gerechnet",
    "Published": "Veröffentlicht",
    "Claimed σ": "Behauptetes σ",
    "Published σ": "σ davon",
    "Equal weights σ": "σ bei gleichen Gewichten",
    "Joint": "Gemeinsam",
    "Joint σ": "Gemeinsames σ",
    "Difference": "Differenz",
    "σ ratio": "Verhältnis der σ",
    "Weighted": "Gewichtet",
    "Equal weights": "Gleiche Gewichte",
    "{name}: {n} iterations, misclosure left {left}″": "{name}: {n} Iterationen, restlicher Widerspruch {left}″",
    "Loop closures": "Schleifenschlüsse",
    "Loop": "Schleife",
    "Misclosure": "Widerspruch",
    "Test": "Test",
    "All {n}": "Alle {n}",
    "The worst {shown} of {n}": "Die {shown} schlechtesten von {n}",
    "open": "offen",
    "pair not used": "Paar nicht verwendet",
    "{shown} independent loops ({note}), from the measured pairs alone, before any adjustment. σ: "
    "of the misclosure, along its direction, from the covariances of the pairs. Test: w′C⁻¹w, chi-square with "
    "{freedom} degrees of freedom; a loop is open where its p is too small for chance at {alpha} % for all loops "
    "together ({failed} are).": (
        "{shown} unabhängige Schleifen ({note}), allein aus den gemessenen Paaren, vor jeder Ausgleichung. σ: des "
        "Widerspruchs in seiner Richtung, aus den Kovarianzen der Paare. Test: w′C⁻¹w, Chi-Quadrat mit {freedom} "
        "Freiheitsgraden; offen ist eine Schleife, deren p bei {alpha} % für alle zusammen zu klein für Zufall ist "
        "({failed} sind es)."
    ),
    "After": "Danach",
    "After: by the adjusted pairs, {form}.": "Danach: mit den ausgeglichenen Paaren, {form}.",
    "all loops closed as conditions": "alle Schleifen als Bedingungen geschlossen",
    "each by the poses of its frames": "jedes aus den Lagen seiner Systeme",
    "Loops through a mount": "Schleifen über eine Aufnahme",
    "Mount": "Aufnahme",
    "σ of the mount": "σ der Aufnahme",
    "Its play": "Ihr Spiel",
    "Loops through a mount close as well as it repeats: σ as given, about and along each axis; its play is "
    "what the adjustment leaves of the misclosure to it.": (
        "Schleifen über eine Aufnahme schließen so gut, wie diese sich wiederholt: σ wie gegeben, um und entlang jeder "
        "Achse; ihr Spiel ist, was die Ausgleichung ihr vom Widerspruch lässt."
    ),
    "Adjusted pairs": "Ausgeglichene Paare",
    "Pair, from a to b": "Paar, von a nach b",
    "Residual": "Verbesserung",
    "Redundancy": "Redundanz",
    "Largest std.": "Größte stand.",
    "Adjusted b_from_a: quaternion w x y z, Euler angles of R = Rz(z) Ry(y) Rx(x) with the σ of small rotations "
    "about the axes of a, translation with its σ along the axes of b. Residual: length of the rotation and of the "
    "translation that takes the measured pair to the adjusted one; of pairs not used, to its prediction. "
    "Redundancy: mean of its components, 0 where nothing checks the pair, 1 where the others alone determine it.": (
        "Ausgeglichenes b_from_a: Quaternion w x y z, Eulerwinkel von R = Rz(z) Ry(y) Rx(x) mit dem σ kleiner "
        "Drehungen um die Achsen von a, Translation mit ihrem σ längs der Achsen von b. "
        "Verbesserung: Betrag der Drehung und der "
        "Translation vom gemessenen zum ausgeglichenen Paar; bei nicht verwendeten zu ihrer Vorhersage. Redundanz: "
        "Mittel der Komponenten, 0 wo nichts das Paar prüft, 1 wo die anderen allein es bestimmen."
    ),
    # observations
    "Other observations": "Weitere Beobachtungen",
    "Kind": "Art",
    "Between": "Zwischen",
    "Component": "Komponente",
    "Observed": "Beobachtet",
    "Adjusted": "Ausgeglichen",
    "Standardized": "Standardisiert",
    "not used": "nicht verwendet",
    "suspect": "verdächtig",
    "uncontrolled": "unkontrolliert",
    "Suspect: |standardized residual| above {limit}. Sigmas are those given to the program.": (
        "Verdächtig: |standardisierte Verbesserung| über {limit}. Die Sigmas sind die dem Programm angegebenen."
    ),
    "The worst {shown} of {n} rows; all in residuals_other.csv.": (
        "Die {shown} schlechtesten von {n} Zeilen; alle in residuals_other.csv."
    ),
    "The {shown} largest of {n}. Test: chi-square with 2 degrees of freedom, suspect above {limit} ({alpha} % "
    "together). The others are in residuals.csv.": (
        "Die {shown} größten von {n}. Test: Chi-Quadrat mit 2 Freiheitsgraden, verdächtig über {limit} ({alpha} % "
        "zusammen). Die anderen stehen in residuals.csv."
    ),
    "Images with the largest residuals": "Bilder mit den größten Verbesserungen",
    "RMS residual [px]": "RMS der Verbesserungen [px]",
    "res. u [px]": "Verb. u [px]",
    "res. v [px]": "Verb. v [px]",
    "std. u": "stand. u",
    "std. v": "stand. v",
    "red. u": "Red. u",
    "red. v": "Red. v",
    # all observations
    "All observations": "Alle Beobachtungen",
    "Where": "Wo",
    "Unit of σ": "Einheit von σ",
    "σ adj.": "σ ausgegl.",
    "Gross error": "Grober Fehler",
    "MDB": "Grenzwert",
    "image point": "Bildpunkt",
    "image": "Bild",
    "reading": "Ablesung",
    "closure": "Schleifenschluss",
    "The worst {shown} of {n}; all in residuals.csv and residuals_other.csv.": (
        "Die {shown} schlechtesten von {n}; alle in residuals.csv und residuals_other.csv."
    ),
    "Every observation, one row per component, largest |w| first. w: Baarda's standardized residual. Gross error: "
    "estimated. MDB: the bias of this component alone that its test finds with the stated power; λ̄: how many of "
    "its sigmas an undetected bias can at most move any function of the unknowns. Click a heading to sort.": (
        "Jede Beobachtung, eine Zeile je Komponente, größtes |w| zuerst. w: standardisierte Verbesserung nach Baarda. "
        "Grober Fehler: geschätzt. Grenzwert: der Fehler dieser Komponente allein, den ihr Test mit der genannten "
        "Macht findet; λ̄: um wie viele seiner Sigmas ein unentdeckter Fehler eine Funktion der Unbekannten höchstens "
        "verschiebt. Ein Klick auf eine Überschrift sortiert."
    ),
    "Power {power} %.": "Macht {power} %.",
    "On the screen this table can be searched and sorted.": (
        "Am Bildschirm lässt sich diese Tabelle durchsuchen und sortieren."
    ),
    "filter": "filtern",
    "only suspect or not used": "nur verdächtige oder nicht verwendete",
    "first page": "erste Seite",
    "page before": "vorige Seite",
    "next page": "nächste Seite",
    "last page": "letzte Seite",
    "page {{page}} of {{pages}}, {{n}} rows": "Seite {{page}} von {{pages}}, {{n}} Zeilen",
    "The survey in space": "Die Vermessung im Raum",
    "Drag to turn, Ctrl and wheel to zoom; arrow keys, + and − do the same.": (
        "Ziehen dreht, Strg und Rad vergrößern; Pfeiltasten, + und − ebenso."
    ),
    "Ellipsoids enlarged": "Ellipsoide vergrößert",
    "nearer": "näher",
    "further away": "weiter weg",
    "times": "mal",
    # what is demanded
    "Identification": "Angaben zur Messung",
    "Tolerances": "Toleranzen",
    '<a href="#tolerances">{n} of {most} demands</a> on the results are not met.': (
        '<a href="#tolerances">{n} von {most} Forderungen</a> an die Ergebnisse sind nicht erfüllt.'
    ),
    "U: expanded uncertainty at 95 % (k = {k}), in the worst direction. |Δ| + U: deviation from nominal with its "
    "uncertainty; what is not proven is not met (ISO 14253-1).": (
        "U: erweiterte Unsicherheit bei 95 % (k = {k}) in der ungünstigsten Richtung. |Δ| + U: Abweichung vom Nennwert "
        "mit ihrer Unsicherheit; was nicht nachgewiesen ist, ist nicht erfüllt (ISO 14253-1)."
    ),
    "Demand": "Forderung",
    "Quantity": "Größe",
    "Found": "Gefunden",
    "Allowed": "Erlaubt",
    "Used [%]": "Ausgenutzt [%]",
    "met": "erfüllt",
    "not met": "nicht erfüllt",
    "position": "Position",
    "rotation": "Drehung",
    "File": "Datei",
    "Hash": "Prüfsumme",
    # kinds of parameters and observations
    "lens": "Objektiv",
    "point": "Punkt",
    "station from camera": "Kamera auf Standpunkt:",
    "world from station": "Standpunkt",
    "mount from station": "Standpunkt auf Tischplatte:",
    "world from table": "Drehtisch",
    "table geometry": "Achsen von Drehtisch",
    "table angles": "Winkel von Drehtisch",
    "carrier from target": "Zieltafel",
    "warp": "Verbiegung",
    "vertical": "Lotrichtung",
    "instrument": "Instrument",
    "orientation": "Orientierung",
    "centring": "Zentrierung",
    "beam": "Laserstrahl",
    "surface": "Fläche",
    "pair": "Paar",
    "distance": "Strecke",
    "coordinates": "Koordinaten",
    "coordinate difference": "Koordinatenunterschied",
    "angle": "Winkel",
    "zenith": "Zenitwinkel",
    "azimuth": "Azimut",
    "slope distance": "Schrägstrecke",
    "horizontal distance": "Horizontalstrecke",
    "height difference": "Höhenunterschied",
    "level": "Neigung",
    "alignment": "Ausrichtung",
    "laser": "Laserpunkt",
    "{n} times weaker together than alone: ": "{n}-mal schwächer zusammen als einzeln: ",
    # statistics
    "Variance components": "Varianzkomponenten",
    "Factor of variance": "Varianzfaktor",
    "σ of it": "σ davon",
    "Factor of σ": "Faktor der σ",
    "p of 1": "p für 1",
    "estimated": "geschätzt",
    "vanished": "verschwunden",
    "unseparable": "nicht trennbar",
    "no redundancy": "ohne Redundanz",
    "not converged": "nicht konvergiert",
    "Estimated variance factor of every group, on top of the sigmas given ({method}, {n} solutions of the survey). "
    "p of 1: probability of a factor as far from 1 where the given sigmas are right. All sigmas and tests in this "
    "report use these factors.": (
        "Geschätzter Varianzfaktor jeder Gruppe, zusätzlich zu den angegebenen Sigmas ({method}, {n} Lösungen). p für "
        "1: Wahrscheinlichkeit eines ebenso weit von 1 entfernten Faktors, wenn die Sigmas stimmen. Alle Sigmas und "
        "Tests in diesem Bericht verwenden diese Faktoren."
    ),
    "Not separable, only their mixture is known: {names}": "Nicht trennbar, nur die Mischung ist bekannt: {names}",
    "Reliability": "Zuverlässigkeit",
    "Not controlled": "Unkontrolliert",
    "Observation": "Beobachtung",
    "MDB [σ]": "Grenzwert [σ]",
    "Moves most": "Verschiebt am meisten",
    "by": "um",
    "in its σ": "in dessen σ",
    "Position": "Position",
    "by [mm]": "um [mm]",
    "Šidák's family-wise control": "Kontrolle aller Tests zusammen nach Šidák",
    "Baarda's B-method": "Baardas B-Methode",
    "External reliability: what the least detectable bias (power {power} %, {method}, level of a single test {level}) "
    "of an observation would do to the unknowns if it stayed undetected. Worst first.": (
        "Äußere Zuverlässigkeit: was der kleinste auffindbare Fehler einer Beobachtung (Macht {power} %, {method}, "
        "Niveau des Einzeltests {level}) unentdeckt an den Unbekannten anrichtet. Das Schlimmste zuerst."
    ),
    "Relative precision": "Relative Genauigkeit",
    "From": "Von",
    "To": "Nach",
    "Distance [mm]": "Strecke [mm]",
    "Rotation σ [″]": "Drehung σ [″]",
    "Relative precision of neighbours, independent of where the datum is: sigma of the distance, semi-axes of the "
    "relative {level} % ellipsoid, and of stations the largest sigma of their relative rotation.": (
        "Genauigkeit von Nachbarn gegeneinander, unabhängig von der Lage des Datums: Sigma der Strecke, Halbachsen des "
        "relativen {level}-%-Ellipsoids, bei Standpunkten das größte Sigma der gegenseitigen Drehung."
    ),
    "Budget": "Unsicherheit",
    "Uncertainty budget": "Unsicherheitsbudget",
    "Result": "Ergebnis",
    "Standard uncertainty u of every result and the share of each source in its variance (GUM, JCGM 100:2008). "
    "Type A: from the scatter of this survey's own residuals; type B: given. ν: effective degrees of freedom; "
    "U = k u is the expanded uncertainty at {level} %.": (
        "Standardunsicherheit u jedes Ergebnisses und der Anteil jeder Quelle an seiner Varianz (GUM, JCGM 100:2008). "
        "Typ A: aus der Streuung der eigenen Verbesserungen; Typ B: gegeben. ν: effektive Freiheitsgrade; U = k u ist "
        "die erweiterte Unsicherheit bei {level} %."
    ),
    "Correlations": "Korrelationen",
    "Correlated above 95 %": "Über 95 % korreliert",
    "Weak directions": "Schwache Richtungen",
    "Blue: positive, red: negative; empty: none. Lines separate the parameters.": (
        "Blau: positiv, rot: negativ, leer: keine. Linien trennen die Parameter."
    ),
    "Distribution": "Verteilung",
    "Distribution of residuals": "Verteilung der Verbesserungen",
    "Quantiles of group {name}": "Quantile der Gruppe {name}",
    "Standardized residuals of each group in order, against the quantiles that as many normally distributed ones "
    "would have. The band holds 95 % of such points one by one.": (
        "Standardisierte Verbesserungen jeder Gruppe der Größe nach, gegen die Quantile ebenso vieler "
        "normalverteilter. Das Band enthält je Punkt 95 % davon."
    ),
} | GERMAN_BATCH

_WHERE = r"camera (\S+) at epoch (\S+), target (\S+)"
GERMAN_MESSAGES = (
    (
        r"global test failed: sigma0 = ([\d.]+), the residuals are larger than the a priori sigmas say "
        r"\(v'Pv = ([\d.]+), expected ([\d.]+) to ([\d.]+)\)",
        "Globaltest nicht bestanden: sigma0 = {}, die Verbesserungen sind größer, als die Sigmas a priori sagen "
        "(v'Pv = {}, erwartet {} bis {})",
    ),
    (
        r"cautious sigmas: sigma0 = ([\d.]+), the residuals are smaller than the a priori sigmas say "
        r"\(v'Pv = ([\d.]+), expected ([\d.]+) to ([\d.]+)\)",
        "Vorsichtige Sigmas: sigma0 = {}, die Verbesserungen sind kleiner, als die Sigmas a priori sagen "
        "(v'Pv = {}, erwartet {} bis {})",
    ),
    (
        r"left out, because every observation of it is left out, or too many are: (.*)",
        "ausgelassen, weil alle oder zu viele Beobachtungen davon ausgelassen sind: {}",
    ),
    (
        r"(.*): (\S+) is left out, but nothing has that name; (.*)",
        "{}: {} ist ausgeschlossen, bezeichnet aber nichts; {}",
    ),
    (
        r"detection: survey\.toml: \[targets\.(.*)\] says columns = (\d+), rows = (\d+), but the images show "
        r"a board of (\d+) x (\d+) inner corners; .*",
        "Erkennung: survey.toml: [targets.{}] nennt columns = {}, rows = {}, die Bilder zeigen aber eine Tafel von "
        "{} x {} inneren Ecken (Ecken werden gezählt, nicht Felder)",
    ),
    (r"detection: (.*): nothing: (.*)", "Erkennung: {}: nichts gefunden: {}"),
    (r"detection: (.*): failed: (.*)", "Erkennung: {}: nicht lesbar: {}"),
    (r"images: (.*) are gone, their points are used: .*", "Bilder: {} fehlen, ihre Punkte werden verwendet"),
    (
        r"images: (.*) have no points, while those of other images were given; .*",
        "Bilder: {} haben keine Punkte, während die anderer Bilder gegeben sind",
    ),
    (
        r"images: (.*) have changed since their points were (?:found|given).*",
        "Bilder: {} sind andere als die, von denen ihre Punkte stammen",
    ),
    (r"images: (.*) were never looked at: .*", "Bilder: {} wurden nie ausgewertet, ihre Zieltafeln fehlen"),
    (
        r"images: (.*) were searched for other targets than survey.toml names now; .*",
        "Bilder: {} wurden nach anderen Zieltafeln durchsucht, als survey.toml jetzt nennt",
    ),
    (_WHERE + ": not used", "Kamera {}, Epoche {}, Zieltafel {}: nicht verwendet"),
    (
        _WHERE + r": (\d+) of (\d+) image points do not fit \(probable gross errors\)",
        "Kamera {}, Epoche {}, Zieltafel {}: {} von {} Bildpunkten passen nicht (wahrscheinlich grobe Fehler)",
    ),
    (
        _WHERE + r": left out as gross errors: (.*)",
        "Kamera {}, Epoche {}, Zieltafel {}: als grobe Fehler ausgelassen: {}",
    ),
    (
        r"Global test failed: residuals are ([\d.]+) times what the sigmas of the observations allow\. .*",
        "Globaltest nicht bestanden: die Verbesserungen sind das {}-fache dessen, was die Sigmas der Beobachtungen "
        "erlauben. Nach groben Fehlern, falschen Sigmas oder einem lückenhaften Modell suchen, zuerst bei den Gruppen.",
    ),
    (
        r"Observations and model agree, with cautious sigmas: residuals are ([\d.]+) times what the sigmas of the "
        r"observations claim\.",
        "Beobachtungen und Modell stimmen überein, die Sigmas sind vorsichtig: die Verbesserungen sind {}-mal so groß, "
        "wie die Sigmas der Beobachtungen angeben.",
    ),
    (
        r"The survey as a whole fits its sigmas, but not every part of it; .*",
        "Das Ganze passt zu seinen Sigmas, aber nicht jeder Teil; was nicht passt, steht zuerst bei den Warnungen.",
    ),
    (
        r"(\S+) (.*) does not fit: its residuals are ([\d.]+) times what the sigmas allow \(variance factor (\S+), "
        r"redundancy ([\d.]+), p (\S+)\)",
        "{} {} passt nicht: die Verbesserungen sind {}-mal so groß, wie die Sigmas erlauben (Varianzfaktor {}, "
        "Redundanz {}, p {})",
    ),
    (r"and (\d+) more parts do not fit", "und {} weitere Teile passen nicht"),
    (
        r"(camera|target|table) (.*): its (.*) is not the one of the other epochs from (.*) on: (.*)",
        "{} {}: {} ist ab {} nicht wie in den anderen Epochen: {}",
    ),
    (r"(camera|target|table) (.*): its (.*) is not as given: (.*)", "{} {}: {} ist nicht wie angegeben: {}"),
    (
        r"The adjustment did not converge: the numbers below are no solution\.",
        "Die Ausgleichung ist nicht konvergiert: die Zahlen unten sind keine Lösung.",
    ),
    (
        r"Nothing was tested: the survey has no redundant observations\.",
        "Nichts wurde geprüft: die Vermessung hat keine überzähligen Beobachtungen.",
    ),
    (
        r"Global test passed, but some observations disagree with the others; see the suspects\.",
        "Globaltest bestanden, aber einige Beobachtungen widersprechen den anderen; siehe die verdächtigen.",
    ),
    (
        r"Observations contradict each other; the probable cause is named first among the warnings\.",
        "Beobachtungen widersprechen einander; die wahrscheinliche Ursache steht als erste unter den Warnungen.",
    ),
    (
        r"Gross errors were left out; what is left agrees\. They are named among the warnings\.",
        "Grobe Fehler wurden ausgelassen; was bleibt, stimmt überein. Sie stehen unter den Warnungen.",
    ),
    (
        r"Global test passed, but tolerances are not met; see the tolerances\.",
        "Globaltest bestanden, aber Toleranzen sind nicht erfüllt; siehe die Toleranzen.",
    ),
    (r"Global test passed; please read the warnings\.", "Globaltest bestanden; bitte die Warnungen lesen."),
    (r"Observations, sigmas and model agree\.", "Beobachtungen, Sigmas und Modell stimmen überein."),
)
