# Headless and as fast as its agent: one trainer, one robot, no log files, no window.
$recordLogfile = false
$enableInternalMonitor = false
$enableRealTimeMode = false
$useRealTime = false
$agentSyncMode = true
$agentStep = 0.02
$monitorStep = 0.02
$serverMultiThreadedMode = false
$threadedAgentControl = false
sparkSetupServer()
sparkResetLogging()
sparkLogErrorToCerr()
run "scripts/materials.rb"
run "naosoccersim.rb"
