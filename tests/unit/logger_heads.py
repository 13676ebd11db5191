"""Heads of files as loggers write them, each with its source, and the row that follows. The channels are three axes of
an accelerometer here; all else is as in the source."""

from __future__ import annotations

from dataclasses import dataclass

DATED = 1_700_000_000.0  # 2023-11-14T22:13:20Z, the first row of all files with dates


@dataclass(frozen=True)
class Head:
    """`row` is a format of k (number of the row), t (s since the first row), d (date and time), ms and us of its
    second, tick (ms since the first row), x, y, z and, with decimal commas, tc, xc, yc, zc. `begins_s`: the first time
    that is read. `refused`: what the message says, "" where the file is read."""

    source: str
    head: str
    row: str
    begins_s: float = 0.0
    step_s: float = 0.01
    columns: str | None = None
    order: str | None = None
    refused: str = ""
    said: str = ""


XYZ = "{x},{y},{z}"
ACTIGRAPH = """Serial Number: NEO1F07120358
Start Time 00:00:00
Start Date 14/02/2017
Epoch Period (hh:mm:ss) 00:00:00
Download Time 16:30:15
Download Date 22/02/2017
Current Memory Address: 0
Current Battery Voltage: 4.08     Mode = 12
--------------------------------------------------
"""
LVM = """LabVIEW Measurement
Writer_Version\t2
Reader_Version\t2
Separator\tTab
Decimal_Separator\t,
Multi_Headings\tNo
X_Columns\tNo
Time_Pref\tRelative
Operator\tEveline
Date\t2019/07/22
Time\t17:18:18,938945770263671875
***End_of_Header***

Channels\t3
Samples\t100\t100\t100
Date\t2019/07/22\t2019/07/22\t2019/07/22
Time\t17:18:18,938945770263671875\t17:18:18,938945770263671875\t17:18:18,938945770263671875
X_Dimension\tTime\tTime\tTime
X0\t0,0000000000000000E+0\t0,0000000000000000E+0\t0,0000000000000000E+0
Delta_X\t0,010000\t0,010000\t0,010000
***End_of_Header***
"""
HIOKI = """"File name","WAVE0001.CSV","V 1.00"
"Title comment",""
"Trigger Time","'12-07-01 09:14:03"
"Ch","Mode","Range","Comment","Scaling","Ratio","Offset"
"CH-1","Voltage","100mV","","Off","-","-"
"CH-2","Voltage","1V","","Off","-","-"
"ALM","Alarm","","",
"Time","CH-1[V]","CH-2[V]","CH-3[V]","ALM-CH1","Event",
"""
HICORDER = """"File name","WAVE0001.CSV","V1.00"
"Title comment",""
"Start trigger time","'10-06-30 15:53:03"
"CH","CH1","CH2","CH3","LA1","LA2",
"Mode","DC","DC","DC","LOGIC","LOGIC",
"Range","500mV","2V","50V","-","-",
"Comment","","","","","",
"Scaling","Off","Off","Off","-","-",
"Ratio"," 1.00000E+00"," 1.00000E+00"," 1.00000E+00","-","-",
"Offset"," 0.00000E+00"," 0.00000E+00"," 0.00000E+00","-","-",
"Time","CH1[V]","CH2[V]","CH3[V]","LA1","LA2",
"""
HIOKI_8807 = """"COMMENT", "8807 MEM DATA"
"DATE", "01-01-1999"
"TIME", "15:26:55"
"NUM_SIGS", 4
"INTERVAL", 1.000E-02
"HORZ_UNITS", "S"
"VERT_UNITS", "S", "V", "V", "V"
"SIGNAL", "TIME", "ACH1", "ACH2", "ACH3"
"DATA"
"""
GRAPHTEC = """Vendor\t"GRAPHTEC   Corporation"
Model\t"GL980"
Version\t"Ver1.20  "\t"Rev0005"
Max. CH\t8
Sampling interval\t10ms
Total data points\t      129437
Start time\t2020-01-24\t16:53:12
End time\t2020-01-24\t17:03:59
AMP settings
CH\tSignal name\tAMP\tInput\tRange\tFilter\tSpan
CH1\t"CH1"\t"M"\tDC\t20mV\t5KHz\t+0.500\t-0.500\tmV\t28\t5\t6\t0
CH2\t"CH2"\t"M"\tDC\t20mV\t5KHz\t+0.500\t-0.500\tmV\t0\t13\t23\t0
Data
Number\tDate&Time\tms\tCH1\tCH2\tCH3
NO.\tTime\tms\tmV\tmV\tmV
"""
GCDC = """;Title, http://www.gcdataconcepts.com, X16-1c
;Version, 1409, Build num, 0x21E, Build date, 20120404 13:16:08,  SN:CCDC42011002237
;Start_time, 2012-10-24, 03:29:25.409
;Temperature, 35.00, deg C,  Vbat, 1681, mv
;Gain, low
;SampleRate, 100,Hz
;Deadband, 0, counts
;DeadbandTimeout, 1,sec
;Headers, time,Ax,Ay,Az
"""
PICOQUAKE = """# PLab PicoQuake Data
# Time: 2024-04-21 15:54:46.333682, Device: D4E9 (E6632891E36F2029)
# Num. samples: 10000, Duration: 5.0 s
# Config: data_rate = 100.0 Hz, filter = 488 Hz, acc_range = 4 g, gyro_range = 250.0 dps
# Integrity: True, Skipped samples: 0

count,a_x,a_y,a_z,g_x,g_y,g_z
"""
LECROY = """LECROY9354,935412345
Segments,1,SegmentSize,502
Segment,Trig Time,TimeSinceFirstSegment
#1,21 Mar 1990 9:37:08,0.0
Time,Ampl,Ampl1,Ampl2
"""
VM_REC = """Version=1.8
Pretrigger=5
Posttrigger=30
SampleRate=100
NumChannels=3
InputName_1=Lager 12
MeasurandName_1=acceleration
x;y;z
"""
GYROFLOW = """GYROFLOW IMU LOG
version,1.3
id,custom_logger_name
orientation,YxZ
fwversion,FIRMWARE_0.1.0
timestamp,1644159993
tscale,0.001
gscale,0.00122173047
ascale,0.00048828125
t,gx,gy,gz,ax,ay,az
"""
HOBO = (
    '"Plot Title: Hobo U23-001 Sample Data"\n"#","Date Time, GMT-08:00","X, g (LGR S/N: 10173910, SEN S/N: 10173910)",'
    '"Y, g (LGR S/N: 10173910, SEN S/N: 10173910)","Z, g (LGR S/N: 10173910, SEN S/N: 10173910)",'
    '"Coupler Detached (LGR S/N: 10173910)","End Of File (LGR S/N: 10173910)"\n'
)
XSENS = """// Start Time: Unknown
// Update Rate: 100.0Hz
// Filter Profile: human (46.1)
// Firmware Version: 4.6.0
PacketCounter\tAcc_X\tAcc_Y\tAcc_Z\tGyr_X\tGyr_Y\tGyr_Z
"""
TOA5 = "{d:%Y-%m-%d %H:%M:%S}"
GGIR = "https://github.com/wadpac/GGIR/issues/"
HEADS = (
    Head("https://help.campbellsci.com/loggernet-manual/ln_manual/campbell_scientific_file_formats/toa5.htm",
         '"TOA5","CR1000","CR1000","1031","CR1000.Std.00.60","CPU:Test.CR1","4062","Test"\n'
         '"TIMESTAMP","RECORD","Acc_X","Acc_Y","Acc_Z"\n"TS","RN","g","g","g"\n"","","Smp","Smp","Smp"\n',
         f'"{TOA5}",{{k}},{XYZ}', DATED, 1.0),
    Head("Campbell Scientific CR5000 manual, 2.4.2 TOA5 ASCII File Format",
         '"TOA5","Bob\'s9K","CR5000","1048575","1.00","EXPLDAT.DLD","4339","Temp"\n'
         '"TIMESTAMP","RECORD","AX_Avg","AY_Avg","AZ_Avg","TC_Avg(1)"\n"TS","RN","g","g","g","degC"\n'
         '"","","Avg","Avg","Avg","Avg"\n', f'"{TOA5}.{{ms:03d}}",{{k}},{XYZ},25.6', DATED,
         columns="time=TIMESTAMP,x=AX_Avg,y=AY_Avg,z=AZ_Avg"),
    Head("https://github.com/usbr/Pisces/issues/55 (TOACI1)",
         '"TOACI1","CR10X","Hourly"\n"TMSTAMP","RECNBR","X","Y","Z"\n', f'"{TOA5}.{{ms:03d}}",{{k}},{XYZ}', DATED),
    Head("https://github.com/OxWearables/stepcount/issues/155 (ActiGraph LEAP)",
         "---------- Data File Created By ActiGraph LEAP v2 ActiLife v7.0.0 Firmware v2.0.1 date format dd/MM/yyyy at "
         "100 Hz  Filter Normal ---------\n" + ACTIGRAPH +
         "Timestamp,Accelerometer X,Accelerometer Y,Accelerometer Z\n",
         f"{{d:%d/%m/%Y %H:%M:%S}}.{{ms:03d}},{XYZ}", DATED),
    Head(GGIR + "75 (ActiGraph GT3X+, no time)",
         "------------ Data File Created By ActiGraph GT3X+ ActiLife v6.13.3 Firmware v3.2.1 date format d/MM/yyyy at "
         "100 Hz  Filter Normal -----------\n" + ACTIGRAPH + "Accelerometer X,Accelerometer Y,Accelerometer Z\n", XYZ,
         said="number of the row, over the 100 Hz"),
    Head("https://github.com/childmindresearch/wristpy/issues/284 (ActiGraph, through a spreadsheet)",
         "------------ Data File Created By ActiGraph GT3X+ gt3x2csv 0.5.0 Firmware v1.9.2 date format d/MM/yyyy at "
         "60 Hz  Filter Normal -----------,,\n" + ACTIGRAPH.replace("\n", ",,\n") +
         "Accelerometer X,Accelerometer Y,Accelerometer Z\n", XYZ, step_s=1 / 60, said="over the 60 Hz"),
    Head(GGIR + "501 (ActiGraph wGT3XBT, date and time apart)",
         "------------ Data Table File Created By ActiGraph wGT3XBT ActiLife v6.12.1 Firmware v1.9.1 date format "
         "M/d/yyyy Filter Normal -----------\n" + ACTIGRAPH + "Date, Time, Axis1,Axis2,Axis3,Steps,Lux\n",
         f"{{d:%m/%d/%Y}},{{d:%H:%M:%S}},{XYZ},0,0", DATED, 1.0, "time=Time,x=Axis1,y=Axis2,z=Axis3"),
    Head("https://github.com/nationalparkservice/hobo-py/issues/2 (HOBO, BoxCar Pro)",
         "Date Time\tX (g) c:1\tY (g) c:1 2\tZ (g) c:3\n", "{d:%m/%d/%y %H:%M:%S}.{ms:03d}\t{x}\t{y}\t{z}", DATED),
    Head("nationalparkservice/hobo-py, test_data/U23-001_HOBOware.csv", HOBO,
         f"{{k}},{{d:%m/%d/%y %I:%M:%S %p}},{XYZ},,", DATED + 8 * 3600, 1.0),
    Head("nationalparkservice/hobo-py, test_data/MX2301_HOBOmobile.csv",
         'Serial Number:20293298 --\n\nDate Time - GMT +05:00,"X, (g)","Y, (g)","Z, (g)",Host Connect,Button '
         'Down,EOF,\n',
         f"{{d:%Y-%m-%d %H:%M:%S}},{XYZ}, , , ,", DATED - 5 * 3600, 1.0),
    Head("Hioki LR8431 manual, appendix 3", HIOKI, f"{{t:.5f}},{XYZ},0,0,",
         columns="time=Time,x=CH-1[V],y=CH-2[V],z=CH-3[V]"),
    Head("Hioki MR8880 manual, appendix 4", HICORDER, f"{{t:.9E}},{XYZ},1,1,",
         columns="time=Time,x=CH1[V],y=CH2[V],z=CH3[V]"),
    Head("Hioki 8807 manual, 12.5 Text File Internal Format", HIOKI_8807, "{t:+.4E}, {x}, {y}, {z}"),
    Head("https://infohub.industry.panasonic.eu/data/fpwin/en/topics/t-0000014608.html",
         "Date,Time,1,2,3\n,,x,y,z\nMOMENT,MOMENT,MOMENT,MOMENT,MOMENT\n", f"{{d:%Y-%m-%d}},{{d:%H:%M:%S}},{XYZ}",
         DATED, 1.0, "time=Time,x=x,y=y,z=z"),
    Head("Keysight 34972A manual, page 186", "Sweep #,Time,Chan 201 (VDC),Chan 202 (VDC),Chan 203 (VDC)\n",
         f"{{k}},{{d:%m/%d/%Y %H:%M:%S}}:{{ms:03d}},{XYZ}", DATED,
         columns="time=Time,x=Chan 201 (VDC),y=Chan 202 (VDC),z=Chan 203 (VDC)"),
    Head("https://github.com/PLab-SI/PicoQuake (acquisition data)", PICOQUAKE, f"{{k}},{XYZ},1.5,2.5,3.5",
         columns="time=time_s,x=a_x,y=a_y,z=a_z",
         said="'count', which counts the samples, over the 100 Hz"),
    Head("https://github.com/gw-pem/kagra-pem/issues/201 (Graphtec GL980)", GRAPHTEC,
         "{k}\t{d:%Y-%m-%d %H:%M:%S}\t{ms:03d}\t{x}\t{y}\t{z}", DATED,
         columns="time=Date&Time,x=CH1,y=CH2,z=CH3"),
    Head("http://exelerus.com/ostic/kb/faq.php?id=33", "DateTime;Magnitude;X;Y;Z\n",
         "{d:%Y-%m-%d %H:%M:%S}.{ms:03d};82.56;{x};{y};{z}", DATED),
    Head("https://github.com/KalebKE/AccelerationExplorer/issues/11", "Timestamp,X,Y,Z\n", f"{{t:.3f}},{XYZ}"),
    Head("http://www.heartsome.de/de/android/aequidistant.html", "s_A;time_A;x_A;y_A;z_A;s_B;time_B;x_B\n",
         "A;{tick};{x};{y};{z};B;{tick};", columns="time=time_A:ms,x=x_A,y=y_A,z=z_A"),
    Head("Gulf Coast Data Concepts X16, as in gcdc.c of OpenSALTO", GCDC, f"{{t:.3f}},{XYZ}"),
    Head("https://www.ni.com/tutorial/4139 (LabVIEW measurement file)",
         LVM.replace("X_Columns\tNo", "X_Columns\tOne").replace(",", ".") +
         "X_Value\tUntitled\tUntitled 1\tUntitled 2\tComment\n",
         "{t:.6f}\t{x}\t{y}\t{z}", columns="time=X_Value,x=Untitled,y=Untitled 1,z=Untitled 2"),
    Head("LabVIEW measurement file without x, as in the tests of plugy (EMBL)",
         LVM + "X_Value\tUntitled\tUntitled 1\tUntitled 2\tComment\n", "\t{xc}\t{yc}\t{zc}",
         columns="time=time_s,x=Untitled,y=Untitled 1,z=Untitled 2", said="over the 100 Hz"),
    Head(GGIR + "123 (Axivity, through a spreadsheet)", "", f"{{d:%M:%S}}.{{ms:03d}},{XYZ}", 13 * 60 + 20.0),
    Head("https://github.com/OxWearables/biobankAccelerometerAnalysis/issues/81 (Axivity, cwa-convert)", "",
         f"{{d:%Y-%m-%d %H:%M:%S}}.{{ms:03d}},{XYZ}", DATED),
    Head("https://github.com/OxWearables/biobankAccelerometerAnalysis/issues/81 (time series)", "time,x,y,z\n",
         f"{{d:%Y-%m-%d %H:%M:%S}}.{{ms:03d}}+0100 [Europe/London],{XYZ}", DATED - 3600),
    Head("https://github.com/opensim-org/opensim-core/issues/2812 (Xsens MT Manager)", XSENS,
         "{packet}\t{x}\t{y}\t{z}\t0.1\t0.2\t0.3", 655.0, said="a counter of 16 bits begins anew"),
    Head("https://github.com/pfizer-opensource/scikit-digital-health/issues/145 (Xsens DOT)",
         "sep=,\nPacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z\n",
         f"{{k}},{{wrapping}},{XYZ},1,2,3", 4294.9, columns="time=SampleTimeFine:us,x=Acc_X,y=Acc_Y,z=Acc_Z",
         said="a counter of 32 bits begins anew"),
    Head("https://github.com/sparkfun/OpenLog_Artemis/issues/57 (micros as a signed number)", "micros,aX,aY,aZ\n",
         f"{{signed}},{XYZ}", 2147.4, columns="time=micros:us,x=aX,y=aY,z=aZ", said="a counter of 32 bits begins anew"),
    Head("https://github.com/NVlabs/FPSci/pull/318 (micros)", "timestamp_us,x,y,z\n", f"{{wrapping}},{XYZ}", 4294.9,
         said="a counter of 32 bits begins anew"),
    Head("Ansys Twin Builder, CSV File Format", '"Time [ms]", "R1.X [V]", "R1.Y [V]", "R1.Z [V]"\n\n',
         f"{{tick}},{XYZ}"),
    Head("LeCroy 9300C manual, E-11, Spreadsheet Format", LECROY, f"{{t:.3f}},{XYZ}"),
    Head("Rohde & Schwarz RTM20 manual, CSV format", "in s,X in V,Y in V,Z in V\n", f"{{t:.5E}},{XYZ}",
         refused="line 1: column time_s is missing in the header 'in s,X in V"),
    Head("https://mmf.de/vm-doc_eng/file_settings.htm (VibroMetra VM-REC)", VM_REC, "{x};{y};{z}",
         said="over the 100 Hz"),
    Head("im-ethz/flirt, test/wearable-data/empatica/info.txt (ACC.csv)",
         "1700000000,1700000000,1700000000\n100,100,100\n",
         XYZ, refused="line 1: column time_s, vx, vy, vz is missing in the header '1,2,3'"),
    Head("https://github.com/MD2Korg/CerebralCortex-Docs (motionsense)",
         "UTC Timestamp,Offset,accelerometer_x,accelerometer_y,accelerometer_z\n",
         f"{{epoch_ms}},-18000000,{XYZ}", DATED),
    Head("https://github.com/CathIAS/TLIO/pull/18 (imu_measurements.txt, us)", "", f"{{epoch_us}},{XYZ}", DATED),
    Head("waterloo-rocketry/Payload-2018, SDFileHeaders.h",
         "Time since startup (ms),Ambient Light (0-1023),Accelerometer X (g),Accelerometer Y (g),Accelerometer Z (g)\n",
         f"{{tick}},512,{XYZ}"),
    Head("ComputerScienceUniUrb/ML-HAR, lib/constants.dart",
         "Timestamp,Acc_x,Acc_y,Acc_z,Acc_timestamp,Acc_gravity_x\n",
         f"{{epoch_ms}},{XYZ},{{tick}},1", refused="line 1: several columns could be time: 'Timestamp', "
         "'Acc_timestamp'"),
    Head("https://github.com/sigrokproject/pulseview/issues/129 (Saleae)", "Time [s],CH_X,CH_Y,CH_Z\n",
         f"{{t:.9f}},{XYZ}"),
    Head("https://github.com/GoldenCheetah/GoldenCheetah/issues/1061", "Minutes,x,y,z\n", f"{{k}},{XYZ}", step_s=60.0,
         columns="time=Minutes:min,x=x,y=y,z=z", said="60 s apart"),
    Head(GGIR + "1237", "time,x,y,z\n", f"{{d:%Y-%m-%dT%H:%M:%S}}.{{ms:03d}}Z,{XYZ}", DATED),
    Head(GGIR + "1178", "time,x,y,z\n", f"{{d:%Y-%m-%dT%H:%M:%S}}.{{ms:03d}}-0400,{XYZ}", DATED + 4 * 3600),
    Head("https://github.com/xeonfusion/VSCaptureMP/issues/5", "Time,RelativeTime,x,y,z\n",
         f"{{d:%m/%d/%Y %H:%M:%S}},72423680,{XYZ}", DATED, 1.0, "time=Time,x=x,y=y,z=z"),
    Head("https://github.com/narunlifescience/AlphaPlot/issues/28",
         "Zeit t / s;Spannung X / V;Spannung Y / V;Spannung Z / V\n",
         "{tc};{xc};{yc};{zc}", columns="time=Zeit t / s,x=Spannung X / V,y=Spannung Y / V,z=Spannung Z / V",
         said="the comma is taken as the decimal mark"),
    Head("https://github.com/markummitchell/engauge-digitizer/issues/364", "# time, x, y, z\n",
         '"{tc}", "{xc}", "{yc}", "{zc}"', said="the comma is taken as the decimal mark"),
    Head("https://github.com/ruuvi/com.ruuvi.station.ios/issues/1156",
         '"Date","Temperature (°F)",RSSI (dBm),Acceleration X(g),Acceleration Y (g),Acceleration Z (g),"Voltage (V)"\n',
         f"{{d:%Y-%m-%d %H:%M:%S}},70.1,-60,{XYZ},3.1", DATED, 1.0),
    Head("https://github.com/seemoo-lab/pyshimmer/issues/2 (Consensys)",
         '"sep=\t"\nShimmer_86A5_Timestamp_Unix_CAL\tShimmer_86A5_Accel_LN_X_CAL\tShimmer_86A5_Accel_LN_Y_CAL\t'
         "Shimmer_86A5_Accel_LN_Z_CAL\nms\tm/(s^2)\tm/(s^2)\tm/(s^2)\n", "{epoch_ms}\t{x}\t{y}\t{z}\t", DATED,
         columns="time=Shimmer_86A5_Timestamp_Unix_CAL,x=Shimmer_86A5_Accel_LN_X_CAL,y=Shimmer_86A5_Accel_LN_Y_CAL,"
         "z=Shimmer_86A5_Accel_LN_Z_CAL"),
    Head("Agilent 4155C manual, 4-11, spreadsheet format", '"NO.","TIME","X","Y","Z"\n"","s","V","V","V"\n',
         f"{{k}},{{t:.4E}},{XYZ}"),
    Head("https://github.com/CapnBry/HeaterMeter/issues/47", "", "{epoch_s},{x},{y},{z}", DATED, 1.0),
    Head("https://github.com/collin80/SavvyCAN/issues/648", "Year,Month,Day,Hour,Minute,Second,Ms,x,y,z\n",
         f"{{d:%Y,%m,%d,%H,%M,%S}},{{ms}},{XYZ}", refused="line 1: column time_s is missing in the header 'Year,Month"),
    Head("https://docs.gyroflow.xyz/app/technical-details/gcsv-format.md", GYROFLOW, f"{{tick}},39,86,183,{XYZ}",
         columns="time=t:ms,x=ax,y=ay,z=az"),
    Head("https://pastebin.com/6rQctbeC (Q Sensor)", "Time,Z-axis,Y-axis,X-axis,Battery,°Celsius,EDA(uS),Event\n"
         "---------------------------------------------------------\n",
         "{d:%H:%M:%S}.{ms:03d},{z},{y},{x},-1,19.100,0.000,0", 80000.0,
         columns="time=Time,x=X-axis,y=Y-axis,z=Z-axis"),
    Head("https://pastebin.com/Vs6Eg6fD", "ACCEL_X ACCEL_Y ACCEL_Z\n", "{d:%Y-%m-%d %H:%M:%S}.{us:06d} {x} {y} {z}",
         refused="line 2: 5 fields, but the header has 3; correct the line|line 1: column"),
    Head("https://github.com/swift-nav/piksi_tools/issues/629 (s under a name with ms)", "tow(msec),x,y,z\n",
         f"{{t:.2f}},{XYZ}", step_s=1e-5, columns="time=tow(msec):ms,x=x,y=y,z=z"),
    Head("https://gist.github.com/Eclectikus/30cecfc6ddecf4ca1916386ec4c15823 (phyphox)",
         '"Time (s)","Linear Acceleration x (m/s^2)","Linear Acceleration y (m/s^2)","Linear Acceleration z (m/s^2)"\n',
         f"{{t:.9E}},{XYZ}"),
    Head("https://pastebin.com/7uLPjaUM", "time,x-acceleration,y-acceleration,z-acceleration\n", f"{{t:.3f}},{XYZ}"),
    Head("Sensor Logger of K. T. H. Choi, Accelerometer.csv", "time,seconds_elapsed,z,y,x\n",
         "{epoch_us}000,{t:.7f},{z},{y},{x}", DATED, said="'time' tells the same times as 'seconds_elapsed'"),
    Head("GI.bench of Gantner, a date in s beside the time since the begin",
         "Absolute Time;Relative Time;V1;V2;V3\nUTC;s;m/s²;m/s²;m/s²\n",
         "{d:%Y-%m-%d %H:%M:%S};{t:.4f};{x};{y};{z}", step_s=0.1,
         said="'Relative Time' tells the same times as 'Absolute Time'"),
    Head("a date in ms beside the time since the begin", "Date;Time;Elapsed Time [s];X;Y;Z\n",
         "{d:%Y-%m-%d};{d:%H:%M:%S}.{ms:03d};{t:.4f};{x};{y};{z}", DATED, said="tells the same times as 'Elapsed Time"),
    Head("Physics Toolbox, G-Force Meter", "time,gFx,gFy,gFz,TgF\n", f"{{t:.6f}},{XYZ},1.0", said="x=gFx in g"),
    Head("Physics Toolbox with commas", "time;gFx;gFy;gFz;TgF\n",
         "{d:%H:%M:%S}:{ms:03d};{xc};{yc};{zc};1,0", 80000.0, said="x=gFx in g"),
    Head("PULSE of BK, text without names",
         "Header Size: 6\nVersion: 20.0\nStart Time: 14:22:13.000\nDelta X: 0.01\nUnit: m/s^2\n",
         "{k}\t{t:.4f}\t{x}\t{y}\t{z}", said="time=2, x=3 in m/s^2"),
    Head("rows that are counted from 1, without names and without a unit", "", f"{{k}},{{t:.4f}},{XYZ}"),
    Head("InfluxDB 2, annotated CSV", "#group,false,false,true,false,false,true\n#datatype,string,long,"
         "dateTime:RFC3339,dateTime:RFC3339,double,string\n#default,_result,,,,,\n"
         ",result,table,_start,_time,_value,_field\n", ",,0,2023-11-14T00:00:00Z,{d:%Y-%m-%dT%H:%M:%S}.{us:06d}Z,{x},x",
         refused="each line has one value, in '_value', and names its channel in '_field': .+rowKey"),
    Head("InfluxDB 2, annotated CSV after pivot", "#group,false,false,false,false,false,false\n#datatype,string,long,"
         "dateTime:RFC3339,double,double,double\n#default,_result,,,,,\n,result,table,_time,x,y,z\n",
         f",,0,{{d:%Y-%m-%dT%H:%M:%S}}.{{us:06d}}Z,{XYZ}", DATED),
    Head("Grafana, one table", '"Series","Time","Value"\n', '"acc_x","{d:%Y-%m-%d %H:%M:%S}.{ms:03d}","{x}"',
         refused="names its channel in 'Series': .+Series joined by time"),
    Head("Grafana, series joined by time", '"Time","{axis=""x""}","{axis=""y""}","{axis=""z""}"\n',
         f"{{epoch_ms}},{XYZ}", DATED),
    Head("VictoriaMetrics, long form", "metric,timestamp,value\n", "acc_x,{epoch_ms},{x}",
         refused="each line has one value, in 'value', and names its channel in 'metric'"),
)  # fmt: skip
