//! `palpate service`: the server under the service control manager of Windows.

use std::ffi::OsString;
use std::fs::OpenOptions;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock, PoisonError, mpsc};
use std::time::{Duration, Instant};

use clap::Parser;
use palpate_refusal::printable::printable;
use tokio_util::sync::CancellationToken;
use windows_service::service::{
    Service, ServiceAccess, ServiceAction, ServiceActionType, ServiceControl, ServiceControlAccept,
    ServiceErrorControl, ServiceExitCode, ServiceFailureActions, ServiceFailureResetPeriod, ServiceInfo,
    ServiceStartType, ServiceState, ServiceStatus, ServiceType,
};
use windows_service::service_control_handler::{self, ServiceControlHandlerResult, ServiceStatusHandle};
use windows_service::service_manager::{ServiceManager, ServiceManagerAccess};
use windows_service::{define_windows_service, service_dispatcher};

use super::serve::{ServeArguments, ServerHost, serve_in};
use super::{Failure, say};

#[derive(clap::Args)]
pub(crate) struct ServiceArguments {
    #[command(subcommand)]
    command: ServiceCommand,
}

#[derive(clap::Subcommand)]
enum ServiceCommand {
    /// Register the server as a service that starts with Windows. Needs the rights of an administrator
    #[command(after_help = "Examples:\n  \
        palpate service install --folder C:\\palpate -- --config palpate.toml\n  \
        palpate service install --name second --folder D:\\second -- --listen 127.0.0.1:7118\n\n\
        This does not start the service: `sc.exe start NAME` does, and so does the next start of Windows. The account \
        needs the right to read the folder, and to write the log and the journals: icacls C:\\palpate /grant \
        \"NT AUTHORITY\\LocalService:(OI)(CI)M\". Accounts without a password work: LocalSystem, \
        NT AUTHORITY\\LocalService, NT AUTHORITY\\NetworkService, and NT SERVICE\\NAME, which only this service has.\n\n\
        To change the options, remove the service and install it again.")]
    Install {
        #[command(flatten)]
        place: ServicePlace,
        /// Account that the service runs as; it must be able to read the configuration and to write the log
        #[arg(long, value_name = "ACCOUNT", default_value = r"NT AUTHORITY\LocalService")]
        account: String,
        /// Options of `palpate serve`, after --
        #[arg(last = true, value_name = "OPTION")]
        serve: Vec<OsString>,
    },
    /// Stop the service and remove it. Needs the rights of an administrator
    Remove {
        /// Name of the service
        #[arg(long, value_name = "NAME", default_value = NAME)]
        name: String,
    },
    /// Serve as a service; only the service control manager can run this
    #[command(hide = true)]
    Run {
        #[command(flatten)]
        place: ServicePlace,
        /// Options of `palpate serve`, after --
        #[arg(last = true, value_name = "OPTION")]
        serve: Vec<OsString>,
    },
}

/// What `install` passes to `run` on its command line.
#[derive(clap::Args, Clone)]
struct ServicePlace {
    /// Name of the service
    #[arg(long, value_name = "NAME", default_value = NAME)]
    name: String,
    /// Folder in which the server runs: relative paths, scenes and scripts are looked for there [default: the current
    /// one]
    #[arg(long, value_name = "DIR")]
    folder: Option<PathBuf>,
    /// File for the log; it grows without a limit [default: palpate.log in the folder]
    #[arg(long, value_name = "FILE")]
    log_file: Option<PathBuf>,
}

const NAME: &str = "palpate";

/// The options of `serve` alone, as the command line of the service has them.
#[derive(Parser)]
#[command(name = "palpate serve", disable_help_flag = true)]
struct ServeOptions {
    #[command(flatten)]
    arguments: ServeArguments,
}

/// Time between two reports to the service control manager while the server starts or stops. Both may take long:
/// journals are read, streams end.
const PROGRESS: Duration = Duration::from_secs(2);

/// Time within which the service control manager expects the next of these reports.
const REPORT_TIMEOUT: Duration = Duration::from_secs(20);

/// Time that Windows gives the service at its own end, in place of about 5 s, which `--shutdown-deadline-s` alone takes.
const PRESHUTDOWN_TIMEOUT: Duration = Duration::from_secs(30);

/// Time before Windows starts a service again that has crashed.
const RESTART_DELAY: Duration = Duration::from_secs(5);

/// Time without a crash after which Windows forgets earlier ones.
const CRASHES_FORGOTTEN: Duration = Duration::from_secs(3600);

/// Time that `remove` waits for the service to stop.
const REMOVE_TIMEOUT: Duration = Duration::from_secs(60);

/// Codes of the system's errors.
const ERROR_ACCESS_DENIED: i32 = 5;
const ERROR_SERVICE_NOT_ACTIVE: i32 = 1062;
const ERROR_FAILED_SERVICE_CONTROLLER_CONNECT: i32 = 1063;

/// What the service runs with, from `run` to the thread on which the service control manager calls it.
static RUN: Mutex<Option<(ServicePlace, Vec<OsString>)>> = Mutex::new(None);

/// Installs, removes or runs the service.
pub(crate) fn service(arguments: ServiceArguments) -> Result<(), Failure> {
    match arguments.command {
        ServiceCommand::Install { place, account, serve } => install(&place, &account, &serve),
        ServiceCommand::Remove { name } => remove(&name),
        ServiceCommand::Run { place, serve } => {
            let name = place.name.clone();
            *RUN.lock().unwrap_or_else(PoisonError::into_inner) = Some((place, serve));
            service_dispatcher::start(name, ffi_service_main).map_err(|error| failed("can't run as a service", &error))
        }
    }
}

/// Returns the code of an error of the system.
fn code(error: &windows_service::Error) -> Option<i32> {
    match error {
        windows_service::Error::Winapi(system) => system.raw_os_error(),
        _ => None,
    }
}

/// Returns a failure with the reason of the system, and what to do about it.
fn failed(what: &str, error: &windows_service::Error) -> Failure {
    let reason = match error {
        windows_service::Error::Winapi(system) => system.to_string(),
        other => other.to_string(),
    };
    let advice = match code(error) {
        Some(ERROR_ACCESS_DENIED) => ". Run this in a terminal of an administrator",
        Some(ERROR_FAILED_SERVICE_CONTROLLER_CONNECT) => {
            ". Only the service control manager runs this: `palpate service install`, then `sc.exe start palpate`"
        }
        _ => "",
    };
    Failure::Failed(format!("{what}: {reason}{advice}"))
}

/// Parses the options of `serve`.
fn options(serve: &[OsString]) -> Result<ServeArguments, Failure> {
    let arguments = std::iter::once(OsString::from("palpate serve")).chain(serve.iter().cloned());
    let options: ServeOptions = palpate_arguments::parse_from(arguments)
        .map_err(|refusal| Failure::Refused(format!("options of serve: {refusal}; see `palpate serve --help`")))?;
    Ok(options.arguments)
}

fn install(place: &ServicePlace, account: &str, serve: &[OsString]) -> Result<(), Failure> {
    options(serve)?;
    let absolute = |path: &Path| {
        std::path::absolute(path).map_err(|error| Failure::Refused(format!("{}: {error}", path.display())))
    };
    let folder = absolute(place.folder.as_deref().unwrap_or(Path::new(".")))?;
    if !folder.is_dir() {
        return Err(Failure::Refused(format!("--folder {}: is not a folder", folder.display())));
    }
    let log_file = place.log_file.as_deref().map_or_else(|| Ok(folder.join("palpate.log")), absolute)?;
    let program = std::env::current_exe().map_err(|error| Failure::Failed(format!("this program's file: {error}")))?;
    let own = ["service", "run", "--name", &place.name].map(OsString::from);
    let paths = [("--folder", folder), ("--log-file", log_file)];
    let paths = paths.into_iter().flat_map(|(option, path)| [option.into(), path.into_os_string()]);
    let info = ServiceInfo {
        name: place.name.clone().into(),
        display_name: format!("Palpate ({})", place.name).into(),
        service_type: ServiceType::OWN_PROCESS,
        start_type: ServiceStartType::AutoStart,
        error_control: ServiceErrorControl::Normal,
        executable_path: program,
        launch_arguments: own.into_iter().chain(paths).chain(["--".into()]).chain(serve.iter().cloned()).collect(),
        dependencies: Vec::new(),
        account_name: Some(account.into()),
        account_password: None,
    };
    let manager = manager(ServiceManagerAccess::CREATE_SERVICE)?;
    let access = ServiceAccess::CHANGE_CONFIG | ServiceAccess::START | ServiceAccess::DELETE;
    let service = manager.create_service(&info, access);
    let service = service.map_err(|error| failed(&format!("can't install the service `{}`", place.name), &error))?;
    configure(&service).map_err(|error| {
        // Nothing stays of a service that is not as it should be.
        let _ = service.delete();
        failed(&format!("can't configure the service `{}`", place.name), &error)
    })?;
    say!("installed the service `{0}`. Start it: sc.exe start {0}", place.name);
    Ok(())
}

/// Sets what a service can't be created with.
fn configure(service: &Service) -> Result<(), windows_service::Error> {
    service.set_description("Serves soft tissue to touch, over gRPC and to browsers")?;
    service.set_preshutdown_timeout(PRESHUTDOWN_TIMEOUT)?;
    // After a crash only: a configuration that is refused stays refused.
    let restart = ServiceAction { action_type: ServiceActionType::Restart, delay: RESTART_DELAY };
    service.update_failure_actions(ServiceFailureActions {
        reset_period: ServiceFailureResetPeriod::After(CRASHES_FORGOTTEN),
        reboot_msg: None,
        command: None,
        actions: Some(vec![restart; 3]),
    })
}

fn manager(access: ServiceManagerAccess) -> Result<ServiceManager, Failure> {
    ServiceManager::local_computer(None::<&str>, access | ServiceManagerAccess::CONNECT)
        .map_err(|error| failed("can't reach the service control manager", &error))
}

fn remove(name: &str) -> Result<(), Failure> {
    let refused = |error| failed(&format!("can't remove the service `{name}`"), &error);
    let access = ServiceAccess::QUERY_STATUS | ServiceAccess::STOP | ServiceAccess::DELETE;
    let service = manager(ServiceManagerAccess::CONNECT)?.open_service(name, access).map_err(refused)?;
    let stopped = stop(&service).map_err(refused)?;
    service.delete().map_err(refused)?;
    if stopped {
        say!("removed the service `{name}`");
    } else {
        say!("the service `{name}` still stops; Windows removes it when it has");
    }
    Ok(())
}

/// Stops a service, and waits for its end. Returns whether it has ended.
fn stop(service: &Service) -> Result<bool, windows_service::Error> {
    let until = Instant::now() + REMOVE_TIMEOUT;
    let mut state = service.query_status()?.current_state;
    if !matches!(state, ServiceState::Stopped | ServiceState::StopPending) {
        match service.stop() {
            // It ended meanwhile.
            Err(error) if code(&error) == Some(ERROR_SERVICE_NOT_ACTIVE) => return Ok(true),
            asked => state = asked?.current_state,
        }
    }
    while state != ServiceState::Stopped && Instant::now() < until {
        std::thread::sleep(Duration::from_millis(100));
        state = service.query_status()?.current_state;
    }
    Ok(state == ServiceState::Stopped)
}

define_windows_service!(ffi_service_main, service_main);

/// Runs on a thread of the service control manager.
fn service_main(_: Vec<OsString>) {
    let Some((place, serve)) = RUN.lock().unwrap_or_else(PoisonError::into_inner).take() else { return };
    // Without a handler there is nobody to report to; the service control manager notices the end of the process.
    let _ = run(&place, &serve);
}

/// The reports of the service's state to the service control manager.
struct StateReports {
    handle: OnceLock<ServiceStatusHandle>,
    /// The state, and the number of reports that it goes on.
    now: Mutex<(ServiceState, u32)>,
}

impl StateReports {
    fn new() -> Self {
        StateReports { handle: OnceLock::new(), now: Mutex::new((ServiceState::StartPending, 0)) }
    }

    /// Reports a state. After the end there is no other.
    fn become_state(&self, state: ServiceState, exit_code: u32) {
        let mut now = self.now.lock().unwrap_or_else(PoisonError::into_inner);
        if now.0 != ServiceState::Stopped {
            *now = (state, 0);
            self.send(*now, exit_code);
        }
    }

    /// Reports that a start or a stop goes on.
    fn go_on(&self) {
        let mut now = self.now.lock().unwrap_or_else(PoisonError::into_inner);
        if matches!(now.0, ServiceState::StartPending | ServiceState::StopPending) {
            now.1 += 1;
            self.send(*now, 0);
        }
    }

    fn send(&self, (state, checkpoint): (ServiceState, u32), exit_code: u32) {
        let Some(handle) = self.handle.get() else { return };
        let is_pending = matches!(state, ServiceState::StartPending | ServiceState::StopPending);
        // The manager may be gone already.
        let _ = handle.set_service_status(ServiceStatus {
            service_type: ServiceType::OWN_PROCESS,
            current_state: state,
            controls_accepted: match state {
                ServiceState::Running => {
                    ServiceControlAccept::STOP | ServiceControlAccept::PRESHUTDOWN | ServiceControlAccept::SHUTDOWN
                }
                _ => ServiceControlAccept::empty(),
            },
            exit_code: match exit_code {
                0 => ServiceExitCode::NO_ERROR,
                code => ServiceExitCode::ServiceSpecific(code),
            },
            checkpoint,
            wait_hint: if is_pending { REPORT_TIMEOUT } else { Duration::ZERO },
            process_id: None,
        });
    }
}

/// Serves until the service control manager asks to stop, and reports each state to it.
fn run(place: &ServicePlace, serve: &[OsString]) -> Result<(), windows_service::Error> {
    let (shutdown, reports) = (CancellationToken::new(), Arc::new(StateReports::new()));
    let (asked, reporting) = (shutdown.clone(), reports.clone());
    let handler = move |control| match control {
        ServiceControl::Stop | ServiceControl::Preshutdown | ServiceControl::Shutdown => {
            reporting.become_state(ServiceState::StopPending, 0);
            asked.cancel();
            ServiceControlHandlerResult::NoError
        }
        ServiceControl::Interrogate => ServiceControlHandlerResult::NoError,
        _ => ServiceControlHandlerResult::NotImplemented,
    };
    let handle = service_control_handler::register(&place.name, handler)?;
    reports.handle.get_or_init(|| handle);
    reports.become_state(ServiceState::StartPending, 0);
    let (over, is_over) = mpsc::channel::<()>();
    let progress = reports.clone();
    std::thread::spawn(move || {
        while is_over.recv_timeout(PROGRESS) == Err(mpsc::RecvTimeoutError::Timeout) {
            progress.go_on();
        }
    });
    let exit_code = match serve_in_place(place, serve, shutdown, reports.clone()) {
        Ok(()) => 0,
        Err(Failure::Refused(_)) => 2,
        Err(Failure::Failed(_) | Failure::Told(_)) => 1,
    };
    drop(over);
    reports.become_state(ServiceState::Stopped, exit_code);
    Ok(())
}

/// Serves in the folder of the service, and writes the reason to the log if that fails.
fn serve_in_place(
    place: &ServicePlace,
    serve: &[OsString],
    shutdown: CancellationToken,
    reports: Arc<StateReports>,
) -> Result<(), Failure> {
    // A failure before the log is open has no place but the exit code of the service.
    if let Some(folder) = &place.folder {
        let entered = std::env::set_current_dir(folder);
        entered.map_err(|error| Failure::Refused(format!("--folder {}: {error}", folder.display())))?;
    }
    let path = place.log_file.as_deref().unwrap_or(Path::new("palpate.log"));
    let opened = OpenOptions::new().create(true).append(true).open(path);
    let file = opened.map_err(|error| Failure::Refused(format!("--log-file {}: {error}", path.display())))?;
    let log = file.try_clone().map_err(|error| Failure::Failed(format!("{}: {error}", path.display())))?;
    let ready = Box::new(move || reports.become_state(ServiceState::Running, 0));
    let host = ServerHost { shutdown, log: Box::new(log), has_colours: false, ready };
    let served = options(serve).and_then(|arguments| serve_in(&arguments, host));
    if let Err(Failure::Failed(reason) | Failure::Refused(reason)) = &served {
        let _ = writeln!(&file, "{}", printable(format_args!("palpate: {reason}")));
    }
    served
}
