"""Small files of every format, written for the tests."""

GKF = """<?xml version="1.0" ?>
<gama-local xmlns="http://www.gnu.org/software/gama/gama-local">
<network axes-xy="ne" angles="left-handed">
<description>
A small net &amp; more
</description>
<parameters sigma-apr="2" conf-pr="0.99" tol-abs="1e6" sigma-act="apriori" />
<points-observations distance-stdev="1.0 2.0 1" direction-stdev="5" zenith-angle-stdev="7" angle-stdev="6">
<point id="A" x="0" y="0" z="10" fix="xyz" />
<point id="B" x="100" y="0" z="12" adj="xyz" />
<point id="C" x="50" y="80" adj="XYZ" />
<point id="D" x="1" y="2" />
<obs from="A">
 <direction to="B" val="0.0000" />
 <direction to="C" val="64.0" stdev="4" extern="mine" />
 <s-distance to="C" val="1000.0" />
 <z-angle to="B" val="98-30-15.5" stdev="2" from_dh="1.5" to_dh="1.6" />
 <direction to="D" val="70" />
</obs>
<obs>
 <angle from="B" bs="C" fs="A" val="50-00-00" stdev="3" />
 <distance from="B" to="C" val="94.3" stdev="2" />
 <azimuth from="A" to="B" val="0.001" stdev="10" />
 <cov-mat dim="3" band="1">
  9 1
  4 2
  100
 </cov-mat>
</obs>
<height-differences>
 <dh from="A" to="B" val="2.001" dist="0.25" />
 <dh from="B" to="C" val="-1.0" stdev="0.7" />
</height-differences>
<vectors>
 <vec from="A" to="B" dx="100.001" dy="0.002" dz="2.003" from_dh="1.0" to_dh="1.5" />
 <vec from="A" to="C" dx="50" dy="80" dz="0" />
 <cov-mat dim="6" band="1"> 1 0.1 2 0 3 0 4 0 5 0 6 </cov-mat>
</vectors>
<coordinates>
 <point id="B" x="100.01" y="0.01" />
 <point id="C" z="11" />
 <cov-mat dim="3" band="0"> 25 16 9 </cov-mat>
</coordinates>
</points-observations>
</network>
</gama-local>
"""

KRUMM = """% a comment
[Project]
Small
[Coordinates]
%  x y
A 0 0
B 100 0
C 50 80
[Datum]
fix xA yA, xB
[Sigma0]
0.5 cm
[Distances]
A B 100.001 0.002 % and so on
A C 94.34
[Directions]
C A 10.5 0.001
C B 81.2
[Angles,dms,s]
A B C 300°00'30.5" 2"
[Azimuth,dms]
B M 68°15'20.7"
[Angles]
B M A 30.0 0.002
"""

LGC = """*TITR
A small net
*OLOC
*CALA
A  0.0 0.0 0.0
B  0.0 10.0 0.0
*POIN
C  5.0 5.0 1.0
*ANGL 10.0
A B 0.0
A C 50.0
*ZENH 20.0
A C 91.0 /0.1000 \\0.2000
*DMES 4.000
A C 7.1414
*END
"""

# ruff: noqa: E501
# reason: the rows of a plain table are as wide as its columns

CSV = """kind,id,from_id,to_id,second_id,setup_id,value_m,value_gon,value_deg,sigma_mm,sigma_cc,sigma_arcsec,x_m,y_m,z_m,sigma_x_mm,sigma_y_mm,sigma_z_mm,hold,datum
bearings,,x,counterclockwise,,,,,,,,,,,,,,,,
point,,A,,,,,,,,,,0,0,0,,,,xyz,
point,,B,,,,,,,,,,10,0,0,,,,,
point,,C,,,,,,,,,,5,5,1,,,,z,
direction,,A,B,,S1,,10.0,,,3,,,,,,,,,
direction,,A,C,,S1,,,54.0,,,1.5,,,,,,,,
slope_distance,,A,B,,,10.001,,,0.5,,,,,,,,,,
angle,,B,C,A,,,60,,,4,,,,,,,,,
coordinate_difference,,A,B,,,,,,,,,10,0,0.01,1,2,3,,
coordinates,,B,,,,,,,,,,10,,,5,,,,
adjusted,,B,,,,,,,,,,10,0,0,1,1,1,,
"""

DBAT = """<?xml version="1.0" encoding="UTF-8"?>
<document dbat_script_version="1.0.0">
  <meta><name>Small</name></meta>
  <input base_dir="$HERE">
    <ctrl_pts><file format="id,label,x,y,z,sxyz">control.txt</file></ctrl_pts>
    <images><file format="id,path">images.txt</file></images>
    <image_pts><file format="im,id,x,y,sxy">points.txt</file></image_pts>
    <cameras><camera><id>1</id><unit>mm</unit><sensor>auto,4.8</sensor><image>1600,1200</image>
      <aspect>1</aspect><focal>8</focal><model>3</model><nK>2</nK><nP>0</nP></camera></cameras>
  </input>
  <operations>
    <operation min_rays="2">check_ray_count</operation>
    <operation><set_bundle_estimate_params><io><all>true</all><pp>false</pp><skew>false</skew></io>
    </set_bundle_estimate_params></operation>
  </operations>
</document>
"""
DBAT_FILES = {
    "control.txt": "# control\n1,CP1,0,1,0,0\n2,CP2,1,1,0,0.002\n",
    "images.txt": "# images\n1, data/one.JPG\n2, data\\two.JPG\n",
    "points.txt": "1, 1, 100.5, 200.25, 0.1\n1, 7, 300, 400, 0.2\n2, 1, 101, 201, 0.1\n2, 7, 301, 401, 0.1\n2, 9, 5, 6, 1\n",
}

AICON = {
    "net.ior": "1 -999 -28.8 0.02 0.05 -1.1e-004 1.5e-007 13.5\n0.0\n5.8e-006 -8.6e-006\n-7.0e-005 -3.1e-005\n"
    "36.0 24.0 9000 6000\n",
    "net.phc": "1 5 7.2 3.6 0.0001 0.0001 0 0 1 1 1\n2 5 -1.0 2.0 0.0001 0.0001 0 0 1 1 1\n2 6 1.0 2.0 0 0 0 0 1 0 1\n"
    "1 8 1.5 2.5 0.0001 0.0001 0 0 1 1 1\n2 8 1.5 2.5 0.0001 0.0001 0 0 1 1 1\n",
    "net.eor": "1 1 1606.3 -869.5 244.4 1.38 0.65 -2.97 0 307 3\n2 1 -676.0 -956.4 1119.5 1.2 -0.6 -0.9 0 307 3\n",
    "net.obc": "5 573.0 -49.4 -121.7 0.003 0.003 0.004 66 1 1 0\n",
    "net.scale": '0 "Scalebar" 5 8 1389.6880 0.0100 1\n',
}
