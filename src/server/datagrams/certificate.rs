//! The certificate of datagram sessions, which the server makes and signs itself. Browsers accept such a certificate
//! by its hash if its key is of P-256 and it is valid for at most 14 days.

use std::time::Duration;

use wtransport::Identity;
use wtransport::tls::error::InvalidSan;
use wtransport::tls::self_signed::time;

/// Time after which a new certificate replaces the current one.
pub(super) const ROTATED: Duration = Duration::from_secs(7 * 24 * 3600);

/// Days for which a certificate is valid. The first has already passed when it is made, since clocks differ.
const VALID_DAYS: u32 = 14;

/// Creates a certificate. Returns it and its SHA-256.
///
/// # Errors
/// Returns an error if the library can't make it.
pub(super) fn make() -> Result<(Identity, [u8; 32]), InvalidSan> {
    let builder = Identity::self_signed_builder().subject_alt_names(["localhost", "127.0.0.1", "::1"]);
    let yesterday = time::OffsetDateTime::now_utc() - time::Duration::DAY;
    let identity = builder.not_before(yesterday).validity_days(VALID_DAYS).build()?;
    let hash = identity.certificate_chain().as_slice()[0].hash();
    Ok((identity, *hash.as_ref()))
}
