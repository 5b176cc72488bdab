#pragma rtGlobals=1
// What afspm needs beside Asylum's own functions. See the README of afspm's plugins/asylum.
// Functions of Asylum's that not every release has are called so that this file compiles without them.

// The bits of ARGetStatus (nan: this release has none), then a value for each name of a list "ScanSize;XOffset;".
Function/S AfspmLook(names)
	String names

	FUNCREF AfspmNoStatus status = $"ARGetStatus"
	String values, one
	Variable i, count = ItemsInList(names)
	sprintf values, "%.15g;", status()
	for (i = 0; i < count; i += 1)
		sprintf one, "%.15g;", GV(StringFromList(i, names))
		values += one
	endfor
	return values
End

Function AfspmNoStatus()
	return NaN
End

Function/S AfspmController()
	return "Igor Pro " + StringByKey("IGORVERS", IgorInfo(0))
End

// Of the spots that a force curve can be taken at, the second is ours; the first is Asylum's own.
Function InitProbePos()
	Wave spotX = root:Packages:MFP3D:Force:SpotX
	Wave spotY = root:Packages:MFP3D:Force:SpotY

	if (numpnts(spotX) < 2)
		Redimension/N=2 spotX, spotY
		spotX[1] = spotX[0]
		spotY[1] = spotY[0]
	endif
	PV("ForceSpotNumber", 1)
	return 0
End

Function SetProbePosX(x)
	Variable x

	Wave spotX = root:Packages:MFP3D:Force:SpotX
	spotX[1] = x
	return 0
End

Function SetProbePosY(y)
	Variable y

	Wave spotY = root:Packages:MFP3D:Force:SpotY
	spotY[1] = y
	return 0
End

Function GetProbePosX()
	Wave spotX = root:Packages:MFP3D:Force:SpotX
	return spotX[1]
End

Function GetProbePosY()
	Wave spotY = root:Packages:MFP3D:Force:SpotY
	return spotY[1]
End

Function/S GetBaseName()
	SVAR baseName = root:Packages:MFP3D:Main:Variables:BaseName
	return baseName
End

Function SetBaseName(name)
	String name

	SVAR baseName = root:Packages:MFP3D:Main:Variables:BaseName
	baseName = name
	return 0
End

// The z feedback, the tip staying where it is when it is switched off. 1: it could not be done.
Function AfspmFeedback(on)
	Variable on

	if (on)
		Execute/Q/Z "SimpleEngageMe(\"SimpleEngageButton\")"
	else
		Execute/Q/Z "ir_StopPISLoop(NaN, LoopName=\"HeightLoop\")"
	endif
	return V_flag != 0
End

// Whether the z feedback is running.
Function AfspmFeedbackOn()
	String/G root:Packages:afspmStatus = ""
	SVAR answer = root:Packages:afspmStatus
	Execute/Q/Z "root:Packages:afspmStatus = td_ReadString(\"PIDSLoop.2.Status\")"
	return str2num(answer) == 1
End
