//! The authentication token for etcd: obtained with a password, and renewed when etcd rejects it.

use std::sync::Arc;

use palpate_proto::etcd::etcdserverpb::AuthenticateRequest;
use palpate_proto::etcd::etcdserverpb::auth_client::AuthClient;
use tokio::sync::Mutex;
use tonic::Status;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::transport::Channel;

use super::options::EtcdOptions;

/// A token and its number, which counts renewals.
#[derive(Clone)]
pub(super) struct Token {
    pub(super) number: u64,
    pub(super) value: MetadataValue<Ascii>,
}

/// Our user, and the token that all calls share.
pub(super) struct Login {
    options: Arc<EtcdOptions>,
    token: Mutex<Option<Token>>,
}

impl Login {
    pub(super) fn new(options: Arc<EtcdOptions>) -> Self {
        Login { options, token: Mutex::new(None) }
    }

    /// Returns the token, after a renewal if the present one has number `stale`. `None` if no user is configured.
    pub(super) async fn token(&self, channel: &Channel, stale: Option<u64>) -> Result<Option<Token>, Status> {
        let Some(user) = &self.options.user else { return Ok(None) };
        let mut kept = self.token.lock().await;
        if let Some(token) = kept.as_ref().filter(|token| Some(token.number) != stale) {
            return Ok(Some(token.clone()));
        }
        let password = self.options.password().map_err(Status::invalid_argument)?;
        let request = AuthenticateRequest { name: user.clone(), password };
        let given = AuthClient::new(channel.clone()).authenticate(request).await?.into_inner().token;
        let Ok(mut value) = MetadataValue::try_from(given) else {
            return Err(Status::invalid_argument("etcd has given a token that is not text"));
        };
        value.set_sensitive(true);
        let number = kept.as_ref().map_or(0, |token| token.number + 1);
        Ok(Some(kept.insert(Token { number, value }).clone()))
    }
}
