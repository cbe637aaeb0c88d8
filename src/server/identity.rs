//! Who may do what: the roles, what each call asks for, and the file that says which token or certificate has which.

use std::path::Path;
use std::sync::Arc;

use http::HeaderValue;
use ring::digest::{SHA256, digest};
use serde::Deserialize;
use subtle::ConstantTimeEq;

use crate::pace::random_bits;
use crate::refusal::{Reason, Refusal, Result, label};

/// What a caller may do. Who has any role may watch, and who may administer may do everything.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Look at sessions whose id one knows.
    Watch,
    /// Hold a tool, or change the tissue.
    Touch,
    /// Make, start, stop and delete sessions.
    Create,
    /// See every session of the server, and all else.
    Administer,
}

impl Role {
    /// All of them.
    pub const ALL: [Role; 4] = [Role::Watch, Role::Touch, Role::Create, Role::Administer];

    /// Its name in files and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Role::Watch => "watch",
            Role::Touch => "touch",
            Role::Create => "create",
            Role::Administer => "administer",
        }
    }

    /// The role of that name.
    pub fn named(name: &str) -> Result<Role> {
        Role::ALL.into_iter().find(|role| role.name() == name).ok_or_else(|| {
            Refusal::new(Reason::WrongKind, "role", format!("`{name}` is none of watch, touch, create, administer"))
        })
    }
}

/// What a call asks of its caller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// Nothing: it tells nothing of any session.
    Open,
    /// This role.
    Role(Role),
}

/// What each call asks for. A call of this server's own that is not here is refused; `tests/identity.rs` goes through the
/// descriptors.
pub const CALLS: &[(&str, Access)] = &[
    ("/grpc.health.v1.Health/Check", Access::Open),
    ("/grpc.health.v1.Health/Watch", Access::Open),
    ("/grpc.reflection.v1.ServerReflection/ServerReflectionInfo", Access::Open),
    ("/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo", Access::Open),
    ("/palpate.v1.AdminService/CutCaller", Access::Role(Role::Administer)),
    ("/palpate.v1.AdminService/CutStream", Access::Role(Role::Administer)),
    ("/palpate.v1.AdminService/FreeTool", Access::Role(Role::Administer)),
    ("/palpate.v1.AdminService/ListCallers", Access::Role(Role::Administer)),
    ("/palpate.v1.AdminService/ListStreams", Access::Role(Role::Administer)),
    ("/palpate.v1.AdminService/ReviveSession", Access::Role(Role::Administer)),
    ("/palpate.v1.HapticService/AcquireTool", Access::Role(Role::Touch)),
    ("/palpate.v1.HapticService/Probe", Access::Role(Role::Watch)),
    ("/palpate.v1.HapticService/ReleaseTool", Access::Role(Role::Touch)),
    ("/palpate.v1.HapticService/SendCommands", Access::Role(Role::Touch)),
    ("/palpate.v1.HapticService/Touch", Access::Role(Role::Touch)),
    ("/palpate.v1.HapticService/WatchSamples", Access::Role(Role::Watch)),
    ("/palpate.v1.SessionService/CreateSession", Access::Role(Role::Create)),
    ("/palpate.v1.SessionService/DeleteSession", Access::Role(Role::Create)),
    ("/palpate.v1.SessionService/GetScript", Access::Role(Role::Watch)),
    ("/palpate.v1.SessionService/GetSession", Access::Role(Role::Watch)),
    ("/palpate.v1.SessionService/GetStateHash", Access::Role(Role::Watch)),
    ("/palpate.v1.SessionService/ListScenes", Access::Role(Role::Watch)),
    ("/palpate.v1.SessionService/ListScripts", Access::Role(Role::Watch)),
    // It tells the ids of all sessions, and who knows an id may go there.
    ("/palpate.v1.SessionService/ListSessions", Access::Role(Role::Administer)),
    ("/palpate.v1.SessionService/PauseSession", Access::Role(Role::Create)),
    ("/palpate.v1.SessionService/StartSession", Access::Role(Role::Create)),
    ("/palpate.v1.SessionService/UpdateTissue", Access::Role(Role::Touch)),
    ("/palpate.v1.ViewService/AcknowledgeFrames", Access::Role(Role::Watch)),
    ("/palpate.v1.ViewService/GetMesh", Access::Role(Role::Watch)),
    ("/palpate.v1.ViewService/GetTexture", Access::Role(Role::Watch)),
    ("/palpate.v1.ViewService/WatchFrames", Access::Role(Role::Watch)),
];

/// What the call of that path asks for; nothing is known of what is not the server's own.
pub fn access(path: &str) -> Option<Access> {
    CALLS.iter().find(|call| call.0 == path).map(|call| call.1)
}

/// Who calls.
#[derive(Debug, Clone)]
pub struct Caller {
    /// As the file calls them, for people.
    pub name: Arc<str>,
    roles: Vec<Role>,
}

impl Caller {
    fn anybody() -> Self {
        Caller { name: "anybody".into(), roles: vec![Role::Administer] }
    }

    /// Who is not asked, at a call that asks for nothing.
    pub(super) fn nobody() -> Self {
        Caller { roles: Vec::new(), ..Caller::anybody() }
    }

    /// Refuses who has not got `role`.
    pub fn needs(&self, role: Role) -> Result<()> {
        if role == Role::Watch || self.roles.contains(&role) || self.roles.contains(&Role::Administer) {
            return Ok(());
        }
        let message = format!("`{}` has not got the role `{}`, which this call asks for", self.name, role.name());
        Err(Refusal::new(Reason::RoleMissing, "", message))
    }
}

/// Every token begins so: it is known for one wherever it turns up.
const PREFIX: &str = "palpate_";

/// A new token, of 256 random bits.
pub fn new_token() -> Result<String> {
    Ok(format!("{PREFIX}{:032x}{:032x}", random_bits()?, random_bits()?))
}

/// The entry of a token in the file of tokens, which does not hold the token itself.
pub fn entry(name: &str, roles: &[Role], token: &str) -> Result<String> {
    label("name", name)?;
    let roles: Vec<_> = roles.iter().map(|role| format!("\"{}\"", role.name())).collect();
    let hash: String = hash(token).iter().map(|byte| format!("{byte:02x}")).collect();
    let name = toml::Value::from(name);
    Ok(format!("[[token]]\nname = {name}\nroles = [{}]\nsha256 = \"{hash}\"\n", roles.join(", ")))
}

/// A token is 256 random bits: its hash needs no salt and no slowness.
fn hash(token: &str) -> [u8; 32] {
    let mut bytes = [0; 32];
    bytes.copy_from_slice(digest(&SHA256, token.as_bytes()).as_ref());
    bytes
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    token: Vec<TokenEntry>,
    #[serde(default)]
    certificate: Vec<CertificateEntry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TokenEntry {
    name: String,
    roles: Vec<Role>,
    sha256: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CertificateEntry {
    name: String,
    roles: Vec<Role>,
}

/// Whom the server knows.
pub struct Credentials {
    /// Nobody is asked.
    open: bool,
    /// A certificate that the file does not name may do everything: there is no file.
    any_certificate: bool,
    tokens: Vec<([u8; 32], Caller)>,
    certificates: Vec<(String, Caller)>,
}

impl Credentials {
    /// Everybody may do everything.
    pub fn open() -> Self {
        Credentials { open: true, any_certificate: false, tokens: Vec::new(), certificates: Vec::new() }
    }

    /// Whoever has a certificate that was checked may do everything.
    pub fn certified() -> Self {
        Credentials { open: false, any_certificate: true, ..Credentials::open() }
    }

    /// Nobody need show anything.
    pub fn is_open(&self) -> bool {
        self.open
    }

    /// Reads a file of tokens.
    pub fn parse(path: &Path, text: &str) -> Result<Self> {
        let file: File = toml::from_str(text).map_err(|e| {
            let line = e.span().map_or(1, |span| text[..span.start].matches('\n').count() + 1);
            // A token may have been written where it does not belong; it must not get into a log.
            let message = if e.message().contains(PREFIX) { "is not what belongs here" } else { e.message() };
            let place = Some(format!("{}:{line}", path.display()));
            Refusal { place, ..Refusal::new(Reason::Unreadable, "", message) }
        })?;
        let caller = |field: &str, name: &str, roles: Vec<Role>| {
            label(field, name)?;
            if roles.is_empty() {
                let why = "are none; one at least of watch, touch, create, administer is needed";
                return Err(Refusal::new(Reason::Missing, format!("{field}.roles"), why));
            }
            Ok(Caller { name: name.into(), roles })
        };
        let mut known = Credentials { open: false, ..Credentials::open() };
        for (index, TokenEntry { name, roles, sha256 }) in file.token.into_iter().enumerate() {
            let field = format!("token[{index}]");
            let wrong = || {
                let message = "must be the 64 hexadecimal digits of a token's SHA-256: `palpate token` makes the entry";
                Refusal::new(Reason::WrongKind, format!("{field}.sha256"), message)
            };
            let hash = from_hex(&sha256).ok_or_else(wrong)?;
            if known.tokens.iter().any(|token| token.0 == hash) {
                let message = "is that of another token of this file, too";
                return Err(Refusal::new(Reason::OutOfRange, format!("{field}.sha256"), message));
            }
            known.tokens.push((hash, caller(&field, &name, roles)?));
        }
        for (index, CertificateEntry { name, roles }) in file.certificate.into_iter().enumerate() {
            let caller = caller(&format!("certificate[{index}]"), &name, roles)?;
            known.certificates.push((name, caller));
        }
        Ok(known)
    }

    /// Who it is that calls, by the header `authorization` if there is one, or else by the names of a certificate.
    pub(super) fn caller(&self, authorization: Option<&HeaderValue>, certificate: Option<&[String]>) -> Result<Caller> {
        if self.open {
            return Ok(Caller::anybody());
        }
        let unknown = |message: &str| Refusal::new(Reason::Unauthenticated, "authorization", message);
        if let Some(value) = authorization {
            let text = value.to_str().unwrap_or_default();
            let token = match text.split_once(' ') {
                Some((scheme, token)) if scheme.eq_ignore_ascii_case("bearer") => token.trim(),
                _ => return Err(unknown("must be `Bearer` and a token")),
            };
            let hash = hash(token);
            // Every one is compared, and each in full: time tells nothing of any.
            let found = self
                .tokens
                .iter()
                .fold(None, |found, (known, caller)| if bool::from(known.ct_eq(&hash)) { Some(caller) } else { found });
            return found.cloned().ok_or_else(|| unknown("is a token that this server does not know"));
        }
        match certificate {
            Some(names) if self.any_certificate => {
                Ok(Caller { name: names.first().map_or("a certificate", String::as_str).into(), ..Caller::anybody() })
            }
            Some(names) => {
                let known = self.certificates.iter().find(|known| names.contains(&known.0));
                let message = "is missing, and the client's certificate is none that the server has roles for";
                known.map(|known| known.1.clone()).ok_or_else(|| unknown(message))
            }
            None => Err(unknown("is missing: `Bearer` and a token of this server")),
        }
    }
}

fn from_hex(text: &str) -> Option<[u8; 32]> {
    let digits = text.len() == 64 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    let mut bytes = [0; 32];
    for (index, byte) in bytes.iter_mut().enumerate().filter(|_| digits) {
        *byte = u8::from_str_radix(&text[2 * index..2 * index + 2], 16).ok()?;
    }
    digits.then_some(bytes)
}
